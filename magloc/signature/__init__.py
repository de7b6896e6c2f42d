"""An object whose path is known: its moment through time, and what of it is permanent, induced or of eddy currents."""
