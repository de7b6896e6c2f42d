from magloc.plots import bounds as _bounds
from magloc.plots import signatures as _signatures
from magloc.plots import surveys as _surveys
from magloc.plots import tracks as _tracks
from magloc.plots.bounds import bound_reach as bound_reach
from magloc.plots.bounds import bound_slices as bound_slices
from magloc.plots.bounds import bound_sphere as bound_sphere
from magloc.plots.calibrations import calibration as calibration
from magloc.plots.compensations import compensation as compensation
from magloc.plots.designs import design as design
from magloc.plots.designs import design_counts as design_counts
from magloc.plots.localization import fixes as fixes
from magloc.plots.localization import residuals as residuals
from magloc.plots.maps import convergence as convergence
from magloc.plots.maps import sources as sources
from magloc.plots.profiles import survey_profiles as survey_profiles
from magloc.plots.style import save as save
from magloc.plots.style import write as write

consistency = _tracks.consistency_figure
cramer_rao_bounds = _bounds.bounds_figure
signature = _signatures.signature_figure
survey = _surveys.survey_figure
source_tracks = _tracks.sources_figure
track = _tracks.track_figure
