"""Table-top satellite: a camera below a sky of LEDs, a planar inertial unit, and their fusion.

The table's frame has X and Y in the plane and Z up [m]. The heading φ is counter-clockwise seen from above, with
v_table = R(φ) v_body and R(φ) = [[cos φ, -sin φ], [sin φ, cos φ]]. The gyro reads dφ/dt.

Source: Bindel, Ivanov, Nuzhdin, Ovchinnikov, Trofimov, Keldysh Institute preprint.
"""

from arrays.io.lazy import lazy_names

__getattr__, __dir__, __all__ = lazy_names(
    __name__,
    {
        "Camera": "adcs.mockup.vision.camera",
        "CameraFix": "adcs.mockup.vision.paper_matcher",
        "CameraOnly": "adcs.mockup.navigation.reintegration",
        "DelayedFilter": "adcs.mockup.navigation.delayed_ekf",
        "ImuOnly": "adcs.mockup.navigation.reintegration",
        "KnownFrame": "adcs.mockup.vision.camera_calibration",
        "LightTracker": "adcs.mockup.vision.predicted_matcher",
        "PaperMatcher": "adcs.mockup.vision.paper_matcher",
        "Pose": "adcs.mockup.vision.camera",
        "PoseOdds": "adcs.mockup.vision.pose_odds",
        "Reintegration": "adcs.mockup.navigation.reintegration",
        "RobustMatcher": "adcs.mockup.vision.robust_matcher",
        "TriangleCatalogue": "adcs.mockup.vision.triangles",
        "calibrated_camera": "adcs.mockup.vision.camera_calibration",
        "camera_latency": "adcs.mockup.navigation.latency",
        "camera_of_footprint": "adcs.mockup.vision.camera",
        "corrected_velocity": "adcs.mockup.navigation.reintegration",
        "find_stars": "adcs.mockup.vision.centroids",
        "finite_difference": "adcs.mockup.navigation.reintegration",
        "footprint": "adcs.mockup.vision.camera",
        "fuse": "adcs.mockup.navigation.fixes",
        "heading_from_fixes": "adcs.mockup.navigation.zeros",
        "led_sky": "adcs.mockup.vision.sky",
        "odds_matcher": "adcs.mockup.vision.odds_matcher",
        "strapdown": "adcs.mockup.navigation.strapdown",
        "undistorted": "adcs.mockup.vision.camera",
        "wrapped": "adcs.mockup.navigation.strapdown",
        "zero_problem": "adcs.mockup.navigation.zeros",
        "zeros_and_start": "adcs.mockup.navigation.zeros",
    },
)
