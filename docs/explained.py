"""Which page of the guide explains a public name, and which picture shows what it finds or draws."""

import re

# Number, title, minutes and the last words in bold of a notebook, as its first cell says them: its card in the gallery.
CARD = re.compile(r"# (\d+)\. ([^\n]+)\n.*?(\d+) minutes.*\*\*(.+?)\*\*", re.DOTALL)
# The picture of what a function finds or draws, on the function's page.
PICTURES = {
    "notebook-01-first-fix.png": ["magloc.locate", "magloc.Fixes", "magloc.Fix", "magloc.plots.fixes"],
    "notebook-09-several-sources.png": ["magloc.Solution"],
    "track-weaving.png": ["magloc.track", "magloc.Track", "magloc.Tracker", "magloc.plots.track"],
    "track-three-magnets.png": ["magloc.track_sources", "magloc.SourcesTrack", "magloc.SourcesTracker"],
    "notebook-08-calibration.png": ["magloc.calibrate", "magloc.Calibration", "magloc.plots.calibration"],
    "bounds-reach.png": ["magloc.cramer_rao_bounds", "magloc.Bounds", "magloc.bound_map", "magloc.plots.bound_reach"],
    "design-half-space.png": ["magloc.design_array", "magloc.Design"],
    "convergence-paper.png": ["magloc.convergence_map", "magloc.plots.convergence"],
    "view-dipole.png": ["magloc.view", "arrays.mesh_of"],
    "notebook-10-ship.png": ["magloc.fit_signature", "magloc.Signature"],
    "view-map.png": ["magloc.source_map"],
    "view-array.png": ["arrays.SensorArray", "arrays.tetrahedron", "arrays.read_array"],
    "gradient-tensor.png": ["magloc.fit_gradient_tensor", "magloc.GradientTensor"],
    "residuals-faulty.png": ["magloc.plots.residuals"],
    "attitude-track.png": ["adcs.estimate", "adcs.AttitudeTrack"],
    "attitude-complementary.png": ["adcs.complementary_filter"],
    "view-mockup.png": ["adcs.mockup.fuse", "adcs.mockup.DelayedFilter"],
}
# The page of the guide on which a name, or all of a module, is explained, in the order of the reference.
EXPLAINED = {
    "array-files": "arrays.SensorArray arrays.Sensor arrays.Calibration arrays.SensorPreset arrays.read_array"
    " arrays.read_sensors arrays.write_array arrays.array_toml arrays.tetrahedron arrays.square"
    " arrays.cross arrays.cube arrays.hexagon arrays.axial arrays.grid arrays.mesh_of",
    "reading-data": "magloc.read_readings magloc.Readings magloc.read_truth magloc.Truth arrays.InputError"
    " arrays.LogColumns arrays.ValidRows",
    "drone-compass": "adcs.calibrate_log adcs.LogCalibration adcs.read_vehicle adcs.VehicleLog sims.FlightSettings"
    " sims.simulate_flight",
    "robot-logs": "magloc.read_log magloc.Log magloc.LogChannel",
    "stated-uncertainty": "arrays.PoseUncertainty",
    "localization": "magloc.locate magloc.Locator magloc.Fixes magloc.Fix magloc.Solution magloc.Source"
    " magloc.SourcePrior magloc.Shape magloc.plots.fixes",
    "sensor-faults": "magloc.plots.residuals",
    "surveys": "magloc.survey magloc.Survey magloc.Target magloc.check_quality magloc.Quality magloc.Terrain"
    " magloc.read_terrain magloc.plots.survey magloc.plots.survey_profiles",
    "review-targets": "magloc.Review",
    "compensation": "magloc.compensate magloc.Compensation magloc.plots.compensation",
    "instruments": "arrays.instrument_names arrays.read_instrument arrays.Instrument arrays.read_track arrays.Track",
    "tracking": "magloc.track magloc.Track magloc.Tracker magloc.RandomWalk magloc.OrnsteinUhlenbeck"
    " magloc.CoordinatedTurn magloc.FreeMotion magloc.track_sources magloc.SourcesTrack"
    " magloc.SourcesTracker magloc.subtract_rest magloc.plots.track magloc.plots.consistency"
    " magloc.plots.source_tracks",
    "live": "magloc.live magloc.viewer.LiveView",
    "moving-arrays": "magloc.MeasuredMotion magloc.KnownMotion",
    "iterated-kalman-filter": "magloc.IteratedExtendedKalmanFilter",
    "ship-signature": "magloc.track_moment magloc.track_moments magloc.MomentTrack magloc.ObjectPath magloc.PathError"
    " magloc.read_object_path magloc.fit_signature magloc.Signature magloc.plots.signature",
    "dipole-moment": "magloc.equivalent_dipole",
    "single-sensor-ranging": "magloc.SourceLine magloc.fit_source_line magloc.distance_along_line",
    "gradient-tensor": "magloc.fit_gradient_tensor magloc.GradientTensor",
    "joystick": "magloc.calibrate_body magloc.BodyPrior magloc.locate_body sims.joystick",
    "calibration": "magloc.calibrate magloc.Calibration magloc.CalibrationPrior magloc.plots.calibration",
    "detection-range-and-bounds": "magloc.cramer_rao_bounds magloc.Bounds magloc.bound_map magloc.moments_on_sphere"
    " magloc.detection_range magloc.MatchedFilterDetector magloc.plots.bound_reach"
    " magloc.plots.bound_slices magloc.plots.bound_sphere magloc.plots.cramer_rao_bounds",
    "array-design": "magloc.design_array magloc.Design magloc.DesignTask magloc.plots.design"
    " magloc.plots.design_counts",
    "convergence-maps": "magloc.convergence_map magloc.source_map magloc.RepeatedFilter magloc.plots.convergence"
    " magloc.plots.sources",
    "monte-carlo": "sims.run_many sims.simulate sims.read_scenario sims.MagneticScenario sims.write_simulation",
    "attitude": "adcs.estimate adcs.EstimatorSettings adcs.Telemetry adcs.read_telemetry adcs.Satellite"
    " adcs.circular_orbit adcs.read_scenario adcs.AttitudeTrack adcs.view adcs.vector_attitude"
    " adcs.attitude_of_vectors adcs.VectorAttitudes adcs.calibrate_magnetometer"
    " adcs.MagnetometerPrior adcs.find_own_fields adcs.OwnFields adcs.BDot adcs.HysteresisRods"
    " adcs.b_dot_gain adcs.detumbled adcs.read_oem adcs.write_oem adcs.read_aem adcs.write_aem"
    " adcs.EllipsoidObserver adcs.BoundedSystem adcs.Ellipsoid sims.AttitudeScenario"
    " sims.experiments.run_scenario sims.experiments.compared_with_paper sims.experiments.detumbling"
    " sims.experiments.switching_loads",
    "inertial-unit": "adcs.complementary_filter adcs.inertial_magnetic_filter adcs.read_imu adcs.HeadingModel"
    " adcs.Gains",
    "own-hardware": "adcs.AttitudeFilter adcs.AttitudeConfig adcs.AttitudeEstimate adcs.SatelliteFilter"
    " adcs.SatelliteEstimate",
    "star-identification": "adcs.solve_photograph adcs.identify_stars adcs.read_picture adcs.combined_star_fixes"
    " adcs.hipparcos_catalogue",
    "table-top-satellite": "adcs.mockup sims.table_run sims.TableScenario sims.CameraErrors sims.rendered_frame"
    " sims.experiments.sky_run sims.experiments.identified_files sims.experiments.fused_runs"
    " sims.experiments.fused_record sims.experiments.zeros_run",
    "figures-and-viewer": "magloc.view",
    "exporting": "magloc.plots.save magloc.plots.write",
}
