"""World coordinates of photographs: FITS headers, read by a decoder that is written from the papers."""

import math

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from adcs.cli.app import main
from adcs.stars.camera import StarCamera
from adcs.stars.identification import StarFix
from adcs.stars.pose import CameraPose
from adcs.stars.wcs import wcs_header
from tests.adcs.stars.skies import photograph
from tests.adcs.stars.test_identification import random_sky
from tests.adcs.stars.test_pictures import CAMERA, SKY, rays


def read_header(text):
    """Cards of a FITS header."""
    assert len(text) % 2880 == 0
    cards = [text[i : i + 80] for i in range(0, len(text), 80)]
    end = cards.index("END".ljust(80))
    assert not "".join(cards[end + 1 :]).strip()
    values = {}
    for card in cards[:end]:
        assert card[8:10] == "= "
        text = card[10:].strip()
        values[card[:8].strip()] = text.strip("' ") if text[0] == "'" else text == "T" if text in "TF" else float(text)
    return values


def sky_of(header, pixels):
    """Right ascension and declination [rad] of pixels (n, 2) by Calabretta and Greisen, sections 2, 5.1.3 and 5.1.7."""
    u, v = (pixels - [header["CRPIX1"], header["CRPIX2"]]).T
    offset = [u.copy(), v.copy()]
    for k, name in enumerate("AB"):
        order = int(header.get(f"{name}_ORDER", 0))
        for p in range(order + 1):
            for q in range(order + 1 - p):
                offset[k] = offset[k] + header.get(f"{name}_{p}_{q}", 0.0) * u**p * v**q
    x, y = np.array([[header[f"CD{i}_{j}"] for j in (1, 2)] for i in (1, 2)]) @ offset
    phi, reach = np.arctan2(x, -y), np.radians(np.hypot(x, y))
    if header["CTYPE1"].startswith("RA---TAN"):
        theta = np.arctan2(1.0, reach)
    else:
        zeta = reach.copy()
        for _ in range(50):
            power = [header.get(f"PV2_{m}", 0.0) for m in range(21)]
            slope = sum(m * c * zeta ** max(m - 1, 0) for m, c in enumerate(power))
            zeta = zeta - (sum(c * zeta**m for m, c in enumerate(power)) - reach) / slope
        theta = 0.5 * math.pi - zeta
    dec0, ra0, turn = math.radians(header["CRVAL2"]), math.radians(header["CRVAL1"]), math.radians(header["LONPOLE"])
    ra = ra0 + np.arctan2(
        -np.cos(theta) * np.sin(phi - turn),
        np.sin(theta) * math.cos(dec0) - np.cos(theta) * math.sin(dec0) * np.cos(phi - turn),
    )
    dec = np.arcsin(np.sin(theta) * math.sin(dec0) + np.cos(theta) * math.cos(dec0) * np.cos(phi - turn))
    return np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)


def fix_of(R, camera, mirrored=False):
    return StarFix(np.zeros((0, 2), dtype=np.intp), 0.0, -20.0, CameraPose(R, camera, np.eye(5)), mirrored)


class TestHeader:
    @pytest.mark.parametrize(
        ("radial", "radial2", "p1", "p2"), [(0.0,) * 4, (0.3, 0.0, 0.0, 0.0), (-0.2, 0.4, 0.01, -0.02)]
    )
    @pytest.mark.parametrize("mirrored", [False, True])
    def test_is_the_direction_of_each_pixel(self, radial, radial2, p1, p2, mirrored):
        """At the poles too; the centre of the picture is half a pixel from the centre of a FITS pixel."""
        camera = StarCamera(400, 300, math.radians(0.1), radial, "pinhole", radial2, (p1, p2))
        points = np.random.default_rng(0).uniform([0, 0], [400, 300], (50, 2))
        looks = [*Rotation.random(5, random_state=1).as_matrix(), np.eye(3), np.diag([1.0, -1.0, -1.0])]
        for R in looks:
            header = read_header(wcs_header(fix_of(R, camera, mirrored)))
            assert header["CTYPE1"] == ("RA---TAN-SIP" if radial else "RA---TAN")
            as_solved = points * [-1.0, 1.0] + [400.0, 0.0] if mirrored else points
            s = (as_solved - [200.0, 150.0]) * math.tan(math.radians(0.1))
            (x, y), squared = s.T, np.sum(s**2, axis=1)
            s = s * (1.0 + radial * squared + radial2 * squared**2)[:, None]
            s[:, 0] += 2.0 * p1 * x * y + p2 * (squared + 2.0 * x**2)
            s[:, 1] += p1 * (squared + 2.0 * y**2) + 2.0 * p2 * x * y
            expected = np.concatenate([s, -np.ones((50, 1))], axis=1) / np.sqrt(1.0 + np.sum(s**2, axis=1))[:, None]
            np.testing.assert_allclose(sky_of(header, points + 0.5), expected @ R.T, atol=1e-9)

    @pytest.mark.parametrize("radial", [0.0, 0.1, -0.35])
    def test_of_an_equidistant_lens(self, radial):
        """ZPN has the polynomial the other way round; to 1e-6 rad, a thousandth of a pixel."""
        camera = StarCamera(400, 300, math.radians(0.1), radial, "equidistant")
        points = np.random.default_rng(0).uniform([0, 0], [400, 300], (50, 2))
        for R in [*Rotation.random(3, random_state=1).as_matrix(), np.eye(3)]:
            header = read_header(wcs_header(fix_of(R, camera)))
            assert header["CTYPE1"] == "RA---ZPN"
            expected = rays(points, camera, "equidistant", radial) @ R.T
            np.testing.assert_allclose(sky_of(header, points + 0.5), expected, atol=1e-6)


class TestCommand:
    @pytest.mark.parametrize("mirrored", [False, True])
    def test_stars_of_the_picture_have_their_places(self, tmp_path, capsys, mirrored):
        """Pixels of a made picture of known attitude, with a lens that shifts corners by 3 pixels."""
        R = Rotation.random(random_state=8).as_matrix()
        picture, points, rows = photograph(SKY, CAMERA, R, np.random.default_rng(9), corner_px=3.0)
        if mirrored:
            picture, points = picture[:, ::-1], points * [-1.0, 1.0] + [640.0, 0.0]
        Image.fromarray(picture.astype(np.uint16)).save(tmp_path / "sky.png")
        ra = np.degrees(np.arctan2(SKY.directions[:, 1], SKY.directions[:, 0])) % 360.0
        columns = SKY.numbers, ra, np.degrees(np.arcsin(SKY.directions[:, 2])), SKY.magnitudes
        np.savetxt(
            tmp_path / "sky.csv", np.column_stack(columns), "%.9g", ",", header="hip,ra_deg,dec_deg,mag", comments=""
        )
        command = ["stars", str(tmp_path / "sky.png"), "--catalogue", str(tmp_path / "sky.csv")]
        assert main([*command, "--scale-arcsec", "61", "--wcs", str(tmp_path / "out")]) == 0
        header = read_header((tmp_path / "out" / "sky.wcs").read_text())
        off = np.linalg.norm(sky_of(header, points + 0.5) - SKY.directions[rows], axis=1) / CAMERA.rad_per_px
        assert np.max(off) < 0.3

    def test_only_solved_pictures_have_one(self, tmp_path, capsys):
        other, _, _ = photograph(random_sky(4), CAMERA, np.eye(3), np.random.default_rng(9))
        Image.fromarray(other.astype(np.uint16)).save(tmp_path / "dark.png")
        (tmp_path / "sky.csv").write_text("hip,ra_deg,dec_deg,mag\n1,2,5,3\n2,3,5,3\n3,4,5,3\n4,5,6,3\n")
        command = ["stars", str(tmp_path / "dark.png"), "--catalogue", str(tmp_path / "sky.csv")]
        assert main([*command, "--scale-arcsec", "61", "--wcs", str(tmp_path / "out")]) == 0
        assert "no fix" in capsys.readouterr().out
        assert not (tmp_path / "out").exists()

    def test_frames_are_refused(self, tmp_path, capsys):
        (tmp_path / "sky.csv").write_text("hip,ra_deg,dec_deg,mag\n1,2,5,3\n2,3,5,3\n3,4,5,3\n4,5,6,3\n")
        assert main(["stars", str(tmp_path), "--catalogue", str(tmp_path / "sky.csv"), "--wcs", "out"]) == 2
        assert "--wcs out: found a folder of frames, expected photographs" in capsys.readouterr().err
