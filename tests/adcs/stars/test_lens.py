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
        pose = CameraPose((R * Rotation.from_rotvec([0.005, -0.005, 0.005])).as_matrix(), start, np.zeros((5, 5)))
        for _ in range(10):
            pose = fit_pose(points, there, pose, start, LensPrior(1e3, 1e3), 1.0)
        assert pose.camera.rad_per_px == pytest.approx(1.5e-3, rel=1e-8)
        assert pose.camera.radial == pytest.approx(0.08, abs=1e-6)
        assert (R.inv() * Rotation.from_matrix(pose.R_catalogue_from_frame)).magnitude() < 1e-8


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
            ('"equidistant"', '"fisheye"', 'projection = \'fisheye\', expected "pinhole" or "equidistant"'),
            ("radial = 0.1", "radial = nan", "radial = nan, expected a finite number"),
            ("width_px = 500", "width_px = 1.5", "width_px = 1.5, expected a positive number, in pixels a whole one"),
            ("scale_arcsec = 316.8", "", "scale_arcsec = None, expected a finite number"),
            ("scale_arcsec = 316.8", "scale_arcsec = 4000", "must be 0.01 to 3600 arc seconds"),
            ("radial = 0.1", "radial =", "found no TOML"),
        ],
    )
    def test_refusals(self, tmp_path, old, new, said):
        (tmp_path / "lens.toml").write_text(TEXT.replace(old, new))
        with pytest.raises(InputError) as refused:
            read_lens(tmp_path / "lens.toml")
        assert said in str(refused.value)
