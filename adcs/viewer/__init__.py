"""Viewer of attitude results in three dimensions, in a browser."""

from magloc.viewer import viser as viser  # names the extra that is missing, if it is
