"""Files of lenses: fitted from one made picture, used for another one."""

import math
import tomllib

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from adcs.cli.app import main
from adcs.stars.camera import StarCamera, as_projection
from adcs.stars.lens import read_lens
from adcs.stars.pose import CameraPose, LensPrior, fit_pose
from arrays.io.errors import InputError
from tests.adcs.stars.test_identification import random_sky
from tests.adcs.stars.test_pictures import rays, wide_photograph

CAMERA = StarCamera(500, 480, math.radians(0.088))
TEXT = 'projection = "equidistant"\nwidth_px = 500\nheight_px = 480\nscale_arcsec = 316.8\nradial = 0.1\n'
TEXT += "scale_sigma_arcsec = 0.1\nradial_sigma = 0.01\n"


class TestCamera:
    BENT = StarCamera(500, 480, 1.5e-3, -0.12, "pinhole", 0.05, (2e-3, -3e-3))

    @pytest.mark.parametrize("projection", ["pinhole", "equidistant"])
    def test_directions_and_places(self, projection):
        """By trigonometry of the angle from the axis; places are the way back."""
        camera = StarCamera(500, 480, math.radians(0.088), -0.2, projection)
        points = np.random.default_rng(0).uniform([0, 0], [500, 480], (50, 2))
        np.testing.assert_allclose(camera.directions(points), rays(points, camera, projection, -0.2), atol=1e-12)
        s = (points - [250.0, 240.0]) * math.tan(camera.rad_per_px)
        q = s * (1.0 - 0.2 * np.sum(s**2, axis=1, keepdims=True))
        np.testing.assert_allclose(camera.places(camera.tangents(points)), q, atol=1e-12)

    def test_changes_of_places(self):
        """By central differences."""
        camera = StarCamera(500, 480, 1e-3, 0.0, "equidistant")
        t, dt = np.random.default_rng(1).uniform(-1.0, 1.0, (2, 20, 2))
        expected = (camera.places(t + 1e-6 * dt) - camera.places(t - 1e-6 * dt)) / 2e-6
        np.testing.assert_allclose(camera.place_changes(t, dt[:, :, None])[..., 0], expected, rtol=1e-6, atol=1e-9)

    def test_another_projection_differs_by_the_fifth_power(self):
        """Halving the field divides the difference of the angles by 32."""
        camera, off = StarCamera(500, 480, 1e-3, 0.1), []
        for half in (1.0, 0.5):
            points = [250.0, 240.0] + half * np.array([[200.0, 100.0]])
            there = as_projection(camera, "equidistant").directions(points)
            off.append(np.linalg.norm(there - camera.directions(points)))
        assert off[0] / off[1] == pytest.approx(32.0, rel=0.2)
        assert as_projection(as_projection(camera, "equidistant"), "pinhole").radial == pytest.approx(0.1)

    def test_exact_stars_give_the_exact_equidistant_lens(self):
        """Gauss–Newton from a lens that is off by 1 % and a pose by 0.5°."""
        true = StarCamera(500, 480, 1.5e-3, 0.08, "equidistant")
        R = Rotation.random(random_state=3)
        points = np.random.default_rng(3).uniform([0, 0], [500, 480], (40, 2))
        there = rays(points, true, "equidistant", 0.08) @ R.as_matrix().T
        start = StarCamera(500, 480, 1.515e-3, 0.0, "equidistant")
        pose = CameraPose((R * Rotation.from_rotvec([0.005, -0.005, 0.005])).as_matrix(), start, np.zeros((8, 8)))
        for _ in range(10):
            pose = fit_pose(points, there, pose, start, LensPrior(1e3, 1e3), 1.0)
        assert pose.camera.rad_per_px == pytest.approx(1.5e-3, rel=1e-8)
        assert pose.camera.radial == pytest.approx(0.08, abs=1e-6)
        assert (R.inv() * Rotation.from_matrix(pose.R_catalogue_from_frame)).magnitude() < 1e-8

    def test_exact_stars_give_the_exact_distortion(self):
        true = self.BENT
        R = Rotation.random(random_state=5)
        points = np.random.default_rng(5).uniform([0, 0], [500, 480], (40, 2))
        pose = fitted(points, true.directions(points) @ R.as_matrix().T, R, 1e-6)
        np.testing.assert_allclose(pose.camera.distortion, true.distortion, atol=1e-8)
        assert (R.inv() * Rotation.from_matrix(pose.R_catalogue_from_frame)).magnitude() < 1e-8

    def test_nees_with_all_terms(self):
        """NEES of 60 poses over 8 states: χ²(480) is within 405 to 565 but for 1 % of seeds."""
        true, rng, total = (
            StarCamera(500, 480, 1.5e-3, -0.12, "pinhole", 0.05, (2e-3, -3e-3)),
            np.random.default_rng(7),
            0.0,
        )
        for R in Rotation.random(60, random_state=8):
            points = rng.uniform([0, 0], [500, 480], (80, 2))
            there = true.directions(points) @ R.as_matrix().T
            pose = fitted(points + 0.3 * rng.standard_normal(points.shape), there, R, 0.3)
            turn = (R.inv() * Rotation.from_matrix(pose.R_catalogue_from_frame)).as_rotvec()
            scale = math.log(pose.camera.rad_per_px / true.rad_per_px)
            error = np.array([*turn, scale, *(pose.camera.distortion - true.distortion)])
            total += error @ np.linalg.solve(pose.covariance, error)
        # The scatter is estimated from 152 numbers: its tails add some per cent.
        assert 405.0 < total < 1.03 * 565.0

    def test_lens_of_another_convention(self):
        """A camera by the formula of OpenCV, which distorts true places, is fitted to a tenth of a pixel over 60°."""
        k1, k2, p1, p2, rad_per_px = -0.18, 0.06, 1e-3, -2e-3, 1.9e-3
        t = np.random.default_rng(9).uniform(-0.45, 0.45, (150, 2))
        x, y, squared = *t.T, np.sum(t**2, axis=1)
        bent = t * (1.0 + k1 * squared + k2 * squared**2)[:, None]
        bent[:, 0] += 2.0 * p1 * x * y + p2 * (squared + 2.0 * x**2)
        bent[:, 1] += p1 * (squared + 2.0 * y**2) + 2.0 * p2 * x * y
        points = bent / math.tan(rad_per_px) + [250.0, 240.0]
        frame = np.column_stack([t, -np.ones(len(t))]) / np.sqrt(1.0 + squared)[:, None]
        R = Rotation.random(random_state=10)
        pose = fitted(points, frame @ R.as_matrix().T, R, 0.02)
        off = pose.camera.directions(points) @ pose.R_catalogue_from_frame.T - frame @ R.as_matrix().T
        assert np.linalg.norm(off, axis=1).max() < 0.1 * rad_per_px


def fitted(points, there, R, noise_px):
    """Pose from a start that is off by 1 % and 0.5°, without knowledge of the lens."""
    start = StarCamera(500, 480, 1.5e-3)
    pose = CameraPose((R * Rotation.from_rotvec([0.005, -0.005, 0.005])).as_matrix(), start, np.zeros((8, 8)))
    for _ in range(12):
        pose = fit_pose(points, there, pose, start, LensPrior(1e3, 1e3, 1e3, 1e3), noise_px)
    return pose


class TestFile:
    def test_is_written_from_one_picture_and_used_for_another(self, tmp_path, capsys):
        """The second picture has the lens of the first within its σ, without a scale."""
        sky = random_sky(9_000)
        for i, R in enumerate(Rotation.random(2, random_state=30).as_matrix()):
            picture = wide_photograph(sky, R, CAMERA, "equidistant", 0.05, np.random.default_rng(i))
            Image.fromarray(picture.astype(np.uint16)).save(tmp_path / f"{i}.png")
        ra = np.degrees(np.arctan2(sky.directions[:, 1], sky.directions[:, 0])) % 360.0
        columns = sky.numbers, ra, np.degrees(np.arcsin(sky.directions[:, 2])), sky.magnitudes
        np.savetxt(
            tmp_path / "sky.csv", np.column_stack(columns), "%.9g", ",", header="hip,ra_deg,dec_deg,mag", comments=""
        )
        given = ["--catalogue", str(tmp_path / "sky.csv"), "--lens", str(tmp_path / "lens.toml")]
        assert main(["stars", str(tmp_path / "0.png"), *given]) == 0
        text = (tmp_path / "lens.toml").read_text()
        assert tomllib.loads(text)["scale_arcsec"] == pytest.approx(0.088 * 3600.0, rel=1e-3)
        assert main(["stars", str(tmp_path / "1.png"), *given]) == 0
        assert "no fix" not in capsys.readouterr().out
        assert (tmp_path / "lens.toml").read_text() == text
        assert main(["stars", str(tmp_path / "1.png"), *given, "--scale-arcsec", "300"]) == 2
        assert "--scale-arcsec: found together with the lens" in capsys.readouterr().err
        Image.fromarray(np.zeros((100, 100), np.uint16)).save(tmp_path / "small.png")
        assert main(["stars", str(tmp_path / "small.png"), *given]) == 2
        assert "found 100 × 100 pixels, expected 500 × 480 as in the lens" in capsys.readouterr().err

    @pytest.mark.parametrize(
        ("old", "new", "said"),
        [
            ('"equidistant"', '"fisheye"', "key projection: found 'fisheye', expected one of pinhole, equidistant"),
            ("radial = 0.1", "radial = nan", "key radial: found nan, expected a finite number"),
            ("width_px = 500", "width_px = 1.5", "key width_px: found a number, expected a whole number"),
            ("width_px = 500", "width_px = 0", "key width_px: found 0, expected a positive whole number"),
            ("scale_arcsec = 316.8", "", "found no key scale_arcsec"),
            ("scale_arcsec = 316.8", "scale_arcsec = 4000", "must be 0.01 to 3600 arc seconds"),
            ("radial = 0.1", "radial =", "line 5: found what is not TOML"),
        ],
    )
    def test_refusals(self, tmp_path, old, new, said):
        (tmp_path / "lens.toml").write_text(TEXT.replace(old, new))
        with pytest.raises(InputError) as refused:
            read_lens(tmp_path / "lens.toml")
        assert said in str(refused.value)
