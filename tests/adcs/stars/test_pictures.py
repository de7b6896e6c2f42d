"""Photographs: files of 8 and 16 bits, lights on a glowing sky, and where a picture looks without its scale."""

import csv
import json
import math
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from scipy.constants import speed_of_light
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import adcs
from adcs.cli.app import main
from adcs.environment.sun import earth_velocity_m_s
from adcs.frames import of_julian_year
from adcs.stars.camera import StarCamera
from adcs.stars.catalogue import SkyCap
from adcs.stars.files import read_star_frames
from adcs.stars.identification import NoFix, StarFix, StarMatcher
from adcs.stars.pictures import find_picture_stars, read_picture
from adcs.stars.pose import UNKNOWN_LENS, LensPrior
from adcs.stars.unknown_scale import identify_at_unknown_scale, solve_photograph
from arrays.io.errors import InputError
from tests.adcs.stars.skies import HARD, photograph
from tests.adcs.stars.test_identification import random_sky

CAMERA = StarCamera(640, 480, math.radians(60.0 / 3600.0))
SKY = random_sky(30_000)


def fits_bytes(values, bitpix, bzero=0.0, blank=0):
    """A FITS file of one image, by the standard: cards of 80, blocks of 2880 bytes, big-endian."""
    cards = ["SIMPLE  =                    T", f"BITPIX  = {bitpix:20d}", "NAXIS   =                    2"]
    cards += [f"NAXIS1  = {values.shape[1]:20d}", f"NAXIS2  = {values.shape[0]:20d}", f"BZERO   = {bzero:20.1f}"]
    cards += [f"BLANK   = {blank:20d}", "END"] if blank else ["END"]
    header = "".join(card.ljust(80) for card in cards).encode()
    kind = {8: ">u1", 16: ">i2", -32: ">f4"}[bitpix]
    data = (values - bzero).astype(kind).tobytes()
    return header.ljust(-(-len(header) // 2880) * 2880) + data.ljust(-(-len(data) // 2880) * 2880, b"\0")


class TestFiles:
    def test_same_in_all_kinds(self, tmp_path):
        values = np.random.default_rng(0).integers(0, 65_535, (70, 90)).astype(np.uint16)
        Image.fromarray(values).save(tmp_path / "a.png")
        Image.fromarray(values).save(tmp_path / "a.tiff")
        (tmp_path / "a.fits").write_bytes(fits_bytes(values[::-1].astype(np.float64), 16, 32768.0))
        for suffix in ("png", "tiff", "fits"):
            np.testing.assert_array_equal(read_picture(tmp_path / f"a.{suffix}"), values)

    def test_masked_pixels_of_fits_files_are_nan(self, tmp_path):
        """NaN of fractions, the value of BLANK of whole numbers."""
        values = np.random.default_rng(0).integers(0, 30_000, (70, 90)).astype(np.float64)
        values[:20, 10:30] = np.nan
        (tmp_path / "a.fits").write_bytes(fits_bytes(values[::-1], -32))
        (tmp_path / "b.fits").write_bytes(fits_bytes(np.nan_to_num(values, nan=-9.0)[::-1], 16, blank=-9))
        for name in "ab":
            np.testing.assert_array_equal(read_picture(tmp_path / f"{name}.fits"), values)
        values[:50] = np.nan
        (tmp_path / "a.fits").write_bytes(fits_bytes(values, -32))
        with pytest.raises(InputError, match="found 29 % finite pixels, expected half"):
            read_picture(tmp_path / "a.fits")

    def test_colours(self, tmp_path):
        values = np.random.default_rng(0).integers(0, 255, (70, 90, 4)).astype(np.uint8)
        Image.fromarray(values, "RGBA").save(tmp_path / "a.png")
        np.testing.assert_allclose(read_picture(tmp_path / "a.png"), values[..., :3].mean(axis=2))

    @pytest.mark.filterwarnings("error")
    @pytest.mark.parametrize("kind", ["PNG", "TIFF", "JPEG"])
    def test_damaged_files_are_refused_in_one_sentence(self, tmp_path, kind):
        """Cut or with a byte changed anywhere: without the decoder's words, or read where the damage is in pixels."""
        rng, path = np.random.default_rng(1), tmp_path / f"a.{kind.lower()}"
        Image.fromarray(rng.integers(0, 255, (70, 90)).astype(np.uint8)).save(path, kind)
        whole = path.read_bytes()
        for i in range(60):
            at = int(rng.integers(len(whole) if i % 2 else 60))
            path.write_bytes(whole[:at] if i % 3 else whole[:at] + bytes([whole[at] ^ 255]) + whole[at + 1 :])
            try:
                assert read_picture(path).ndim == 2
            except InputError as error:
                said = str(error).removeprefix(f"{path}: ")
                assert re.fullmatch(
                    r"found (no picture that can be read|a picture of shape|too many|\d+ × \d+).*", said
                )

    def test_a_masked_photograph_is_solved(self, tmp_path):
        """A third of the picture is masked; the attitude stays within a fifth of a pixel of the true one."""
        R = Rotation.random(random_state=8).as_matrix()
        picture, _, _ = photograph(SKY, CAMERA, R, np.random.default_rng(9))
        picture[:120], picture[:, 500:] = np.nan, np.nan
        (tmp_path / "masked.fits").write_bytes(fits_bytes(picture[::-1], -32))
        _, found = solve_photograph(read_picture(tmp_path / "masked.fits"), SKY)
        off = np.linalg.norm(found.R_catalogue_from_frame[:, 2] - R[:, 2])
        assert off < 0.2 * CAMERA.rad_per_px

    def test_refusals(self, tmp_path):
        (tmp_path / "no.png").write_bytes(b"no picture")
        Image.fromarray(np.zeros((20, 90), np.uint8)).save(tmp_path / "small.png")
        (tmp_path / "cube.fits").write_bytes(b"SIMPLE  = T".ljust(80) + b"END".ljust(2800))
        for name, said in (
            ("none.png", "does not exist"),
            ("no.png", "no picture that can be read"),
            ("small.png", "expected 64 × 64 pixels"),
            ("cube.fits", "no image in two dimensions"),
        ):
            with pytest.raises(InputError, match=said):
                read_picture(tmp_path / name)


class TestLights:
    @pytest.mark.parametrize("hard", [{}, HARD])
    def test_places_and_sigma(self, hard):
        """Nearly every light that is clear of the noise, to a tenth of a pixel, its σ true to a factor of two."""
        distances, sigmas, there = [], [], 0
        for seed, R in enumerate(Rotation.random(6, random_state=1).as_matrix()):
            picture, points, rows = photograph(SKY, CAMERA, R, np.random.default_rng(seed), **hard)
            lights = find_picture_stars(picture)
            bright = points[SKY.magnitudes[rows] < 8.5]
            distance, light = cKDTree(lights.points_px).query(bright)
            there += len(bright)
            distances.append(distance[distance < 1.0])
            sigmas.append(lights.sigma_px[light[distance < 1.0]])
        distance, sigma = np.concatenate(distances), np.concatenate(sigmas)
        assert len(distance) > 0.9 * there > 50
        assert np.median(distance) < 0.1
        # The median of a Rayleigh distribution; of some hundred numbers it is known to a tenth.
        assert np.median(distance / sigma) == pytest.approx(math.sqrt(2.0 * math.log(2.0)), rel=0.3)

    def test_hot_pixels_and_noise_are_no_lights(self):
        """Of 300,000 pixels some tens of 5 σ may be noise; none of the hot ones, which are brighter than most stars."""
        empty = random_sky(4)
        picture, _, _ = photograph(empty, CAMERA, np.eye(3), np.random.default_rng(1), **HARD | {"hot": 200})
        assert len(find_picture_stars(picture)) < 20

    def test_masked_pixels(self):
        """Lights clear of the mask are the same ones at the same places; none is in the mask or at its edge."""
        picture, _, _ = photograph(SKY, CAMERA, np.eye(3), np.random.default_rng(5))
        mask = np.zeros(picture.shape, dtype=bool)
        mask[:150, 300:520] = True
        mask[np.random.default_rng(6).uniform(size=mask.shape) < 0.001] = True
        whole, masked = find_picture_stars(picture), find_picture_stars(np.where(mask, np.nan, picture))
        near = cKDTree(np.argwhere(mask)[:, ::-1] + 0.5)

        def clear_px(lights):
            return near.query(lights.points_px * [1.0, -1.0] + [0.0, 480.0])[0]

        assert clear_px(masked).min() > 2.0
        bright = whole.points_px[clear_px(whole) > 8.0]
        assert len(bright) > 0.6 * len(whole)
        assert cKDTree(masked.points_px).query(bright)[0].max() < 0.05

    def test_a_dark_picture(self):
        rng = np.random.default_rng(2)
        picture, points, _ = photograph(SKY, CAMERA, np.eye(3), rng)
        glow = np.zeros(picture.shape)
        glow[100:103, 200:203] = 20_000.0
        bright = find_picture_stars(picture + glow).points_px[0]
        np.testing.assert_allclose(bright, [201.5, 480.0 - 101.5], atol=0.2)
        assert np.linalg.norm(points - find_picture_stars(picture + glow, glow).points_px[0], axis=1).min() < 0.5

    def test_eight_bits(self):
        picture, points, rows = photograph(SKY, CAMERA, np.eye(3), np.random.default_rng(3))
        lights = find_picture_stars(np.clip(np.round(picture / 60.0), 0, 255))
        bright = points[SKY.magnitudes[rows] < 6.5]
        assert (cKDTree(lights.points_px).query(bright)[0] < 0.5).mean() > 0.9


def direction(ra_deg, dec_deg):
    ra, dec = np.radians([ra_deg, dec_deg])
    return np.array([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)])


def is_right(found, R):
    """Whether a fix looks where the camera did."""
    turn = found.R_catalogue_from_frame @ R.T
    scale = found.pose.camera.rad_per_px / CAMERA.rad_per_px
    return Rotation.from_matrix(turn).magnitude() < math.radians(0.05) and abs(scale - 1.0) < 1e-3


class TestUnknownScale:
    @pytest.mark.slow
    def test_photographs(self):
        """With gradient, vignetting, hot pixels and trails, the scale wrong by up to 10 %."""
        rng = np.random.default_rng(4)
        solved = 0
        for i, R in enumerate(Rotation.random(6, random_state=5).as_matrix()):
            picture, _, _ = photograph(SKY, CAMERA, R, rng, **HARD, trail_px=3.0 * (i % 2))
            given = CAMERA.rad_per_px * rng.uniform(0.92, 1.08)
            _, found = solve_photograph(picture, SKY, rad_per_px=given, tolerance=0.1)
            assert isinstance(found, NoFix) or is_right(found, R)
            solved += isinstance(found, StarFix)
            if isinstance(found, StarFix):
                assert abs(found.pose.camera.rad_per_px - CAMERA.rad_per_px) < 5.0 * CAMERA.rad_per_px * math.sqrt(
                    found.pose.covariance[3, 3]
                )
        assert solved >= 5

    @pytest.mark.slow
    def test_without_any_scale(self):
        R = Rotation.random(random_state=6).as_matrix()
        picture, _, _ = photograph(SKY, CAMERA, R, np.random.default_rng(7))
        assert is_right(solve_photograph(picture, SKY)[1], R)

    @pytest.mark.parametrize("axis", [0, 1])
    def test_a_mirrored_picture_is_named(self, axis):
        """Attitude of the picture with left and right exchanged: upside down where it was mirrored that way."""
        R = Rotation.random(random_state=axis).as_matrix()
        picture, _, _ = photograph(SKY, CAMERA, R, np.random.default_rng(axis))
        _, found = solve_photograph(np.flip(picture, axis), SKY, rad_per_px=CAMERA.rad_per_px, tolerance=0.1)
        assert found.mirrored
        assert is_right(found, R if axis else R * [-1.0, -1.0, 1.0])
        assert not solve_photograph(picture, SKY, rad_per_px=CAMERA.rad_per_px)[1].mirrored

    @pytest.mark.slow
    def test_another_sky_gives_no_fix(self):
        """Chance produces one in a million."""
        other = random_sky(30_000, seed=1)
        for seed in range(6):
            R = Rotation.random(random_state=seed).as_matrix()
            picture, _, _ = photograph(other, CAMERA, R, np.random.default_rng(seed))
            assert isinstance(solve_photograph(picture, SKY, rad_per_px=CAMERA.rad_per_px)[1], NoFix)

    @pytest.mark.parametrize("corner_px", [-8.0, -2.0, 3.0, 8.0])
    def test_the_lens_is_found_with_its_sign(self, corner_px):
        """Negative where stars of a corner stand nearer to the centre: the deviations are of a Gaussian, so 1e-6."""
        R = Rotation.random(random_state=3).as_matrix()
        picture, _, _ = photograph(SKY, CAMERA, R, np.random.default_rng(3), corner_px=corner_px)
        _, found = solve_photograph(picture, SKY, rad_per_px=CAMERA.rad_per_px)
        assert is_right(found, R)
        sigma_px = math.sqrt(found.pose.covariance[4, 4]) * CAMERA.corner**2 * 400.0
        assert found.pose.camera.corner_shift_px == pytest.approx(corner_px, abs=5.0 * sigma_px)
        assert sigma_px < 0.3

    @pytest.mark.parametrize("rad_per_px", [CAMERA.rad_per_px, None])
    def test_a_hint_of_direction_is_kept(self, rad_per_px):
        """Same stars as without it; a hint 5° off with a radius of 3° gives no fix, although the picture has one."""
        R = Rotation.random(random_state=11).as_matrix()
        picture, points, rows = photograph(SKY, CAMERA, R, np.random.default_rng(11))
        right = SkyCap(Rotation.from_rotvec(math.radians(2.0) * R[:, 0]).apply(-R[:, 2]), math.radians(3.0))
        wrong = SkyCap(Rotation.from_rotvec(math.radians(5.0) * R[:, 1]).apply(-R[:, 2]), math.radians(3.0))
        lights, found = solve_photograph(picture, SKY, rad_per_px=rad_per_px, near=right)
        assert is_right(found, R)
        distance, star = cKDTree(points).query(lights.points_px[found.stars[:, 0]])
        assert (rows[star[distance < 1.0]] == found.stars[distance < 1.0, 1]).mean() > 0.95
        _, nothing = solve_photograph(picture, SKY, rad_per_px=rad_per_px, near=wrong)
        assert re.match(r"not solved near RA [\d.]+°, Dec [-+][\d.]+° within 3°: ", nothing.reason)

    def test_a_hint_where_the_catalogue_is_empty(self):
        few = SKY.rows(np.flatnonzero(SKY.directions[:, 2] > 0.5))
        picture, _, _ = photograph(SKY, CAMERA, np.eye(3), np.random.default_rng(1))
        _, nothing = solve_photograph(picture, few, rad_per_px=1e-4, near=SkyCap.of(0.0, -1.5, 0.1))
        assert "not solved near" in nothing.reason

    def test_refusals(self):
        points, ones = np.ones((5, 2)), np.ones(5)
        with pytest.raises(ValueError, match=r"tolerance must be at most 0\.1"):
            identify_at_unknown_scale(SKY, 640, 480, points, ones, rad_per_px=1e-4, tolerance=0.2)
        assert "3 stars, 4 needed" in identify_at_unknown_scale(SKY, 640, 480, points[:3], ones[:3]).reason
        with pytest.raises(ValueError, match="picture must have 64 pixels"):
            solve_photograph(np.zeros((10, 10)), SKY)
        with pytest.raises(ValueError, match="dark must have shape"):
            solve_photograph(np.zeros((100, 100)), SKY, dark=np.zeros((10, 10)))


class TestSequence:
    def test_the_last_picture_helps(self, monkeypatch):
        """The fix is the same to a hundredth of a pixel without a search of the whole sky, and right after a leap."""
        turns = Rotation.from_rotvec([[0.0, 0.0, 0.0], [0.03, 0.02, 0.1], [1.0, 2.0, 0.0]])
        turns = turns * Rotation.random(random_state=8)
        pictures = [photograph(SKY, CAMERA, R, np.random.default_rng(1))[0] for R in turns.as_matrix()]
        (_, first), (_, second), (_, third) = (solve_photograph(picture, SKY) for picture in pictures)
        with monkeypatch.context() as patch:
            patch.setattr("adcs.stars.unknown_scale.ranked_triangles", None)
            _, tracked = solve_photograph(pictures[1], SKY, last=first)
        for found, expected in ((tracked, second), (solve_photograph(pictures[2], SKY, last=first)[1], third)):
            turn = Rotation.from_matrix(found.R_catalogue_from_frame.T @ expected.R_catalogue_from_frame).magnitude()
            assert turn < 0.01 * CAMERA.rad_per_px


class TestHipparcos:
    def test_stars_of_any_almanac(self):
        """Sirius, Vega and Polaris in J2000, and Barnard's star, which moves by 10.36 arc seconds a year."""
        catalogue = adcs.hipparcos_catalogue(2000.0)
        place = {int(number): i for i, number in enumerate(catalogue.numbers)}
        for number, ra, dec, magnitude in (
            (32349, 101.2872, -16.7161, -1.09),
            (91262, 279.2347, 38.7837, 0.09),
            (11767, 37.9546, 89.2641, 2.1),
        ):
            expected = [*np.cos(np.radians([ra, ra - 90.0])) * math.cos(math.radians(dec)), math.sin(math.radians(dec))]
            np.testing.assert_allclose(catalogue.directions[place[number]], expected, atol=2e-5)
            assert catalogue.magnitudes[place[number]] == pytest.approx(magnitude, abs=0.1)
        later = adcs.hipparcos_catalogue(2010.0)
        moved = later.directions[place[87937]] - catalogue.directions[place[87937]]
        assert math.degrees(np.linalg.norm(moved)) * 3600.0 == pytest.approx(103.6, abs=0.5)

    def test_aberration(self):
        """That of the standards of astronomy, whose deflection of light by the Sun is none at this distance of it."""
        erfa = pytest.importorskip("erfa")
        utc = of_julian_year(2026.9)
        velocity, catalogue = earth_velocity_m_s(utc), adcs.hipparcos_catalogue(2026.9)
        assert 29.2e3 < np.linalg.norm(velocity) < 30.4e3
        seen = catalogue.aberrated(velocity).directions[::500]
        beta = velocity / speed_of_light
        expected = erfa.ab(catalogue.directions[::500], beta, 1e12, math.sqrt(1.0 - beta @ beta))
        np.testing.assert_allclose(seen, expected, rtol=0.0, atol=1e-12)
        off = np.linalg.norm(seen - catalogue.directions[::500], axis=1)
        assert 20.0 < math.degrees(off.max()) * 3600.0 < 20.8

    @pytest.mark.parametrize(("off", "lens"), [(1.0, LensPrior()), (0.955, UNKNOWN_LENS), (1.045, UNKNOWN_LENS)])
    def test_frames(self, data_folder, off, lens):
        camera, frames = read_star_frames(data_folder / "star-frames")
        catalogue = adcs.hipparcos_catalogue(1991.25)
        matcher = StarMatcher.of(catalogue, replace(camera, rad_per_px=off * camera.rad_per_px))
        right = identified = there = 0
        for frame in frames:
            there += np.count_nonzero(np.isin(frame.numbers, catalogue.numbers))
            fix = matcher.identify(frame.points_px, frame.magnitudes, lens)
            right += np.count_nonzero(catalogue.numbers[fix.stars[:, 1]] == frame.numbers[fix.stars[:, 0]])
            identified += len(fix.stars)
        assert right / there > 0.993
        assert right / identified > 0.999

    @pytest.mark.parametrize(
        ("name", "ra", "dec", "matched", "residual"),
        [
            ("esa-alt40.tiff", 230.67, 11.04, 60, 15.0),
            pytest.param("openstartracker-3.png", 169.99, 13.75, 10, 10.0, marks=pytest.mark.slow),
            pytest.param("openstartracker-6.png", 151.97, 19.15, 10, 10.0, marks=pytest.mark.slow),
            ("openstartracker-8.png", 161.48, 4.37, 7, 10.0),
        ],
    )
    def test_photographs_from_the_file_alone(self, data_folder, capsys, tmp_path, name, ra, dec, matched, residual):
        path = data_folder / "star-photographs" / name
        assert main(["stars", str(path), "--catalogue", "hipparcos", "--json", "--out", str(tmp_path)]) == 0
        (row,) = json.loads(capsys.readouterr().out)["pictures"]
        assert row["solved"]
        assert (row["ra_deg"], row["dec_deg"]) == pytest.approx((ra, dec), abs=0.02)
        assert row["matched"] >= matched
        assert row["residual_arcsec"] < residual
        scale = 40.3 if name.startswith("esa") else 15.73
        assert row["scale_arcsec"] == pytest.approx(scale, rel=2e-3)
        assert (tmp_path / f"{Path(name).stem}-stars.png").stat().st_size > 10_000


def rays(points, camera, projection, radial):
    """Unit vectors of points (n, 2): q = s (1 + radial s²) is the tangent or the angle from the axis."""
    s = (points - 0.5 * np.array([camera.width_px, camera.height_px])) * math.tan(camera.rad_per_px)
    q = np.linalg.norm(s, axis=1) * (1.0 + radial * np.sum(s**2, axis=1))
    angle = np.arctan(q) if projection == "pinhole" else q
    across = s / np.linalg.norm(s, axis=1)[:, None] * np.sin(angle)[:, None]
    return np.concatenate([across, -np.cos(angle)[:, None]], axis=1)


def wide_photograph(sky, R, camera, projection, radial, rng):
    """A picture of 16 bits as in `photograph`; the pixel of each star by interpolation of the lens's own law."""
    seen = sky.directions @ R
    angle = np.arccos(np.clip(-seen[:, 2], -1.0, 1.0))
    s = np.linspace(0.0, camera.corner * 1.1, 20_000)
    q = s * (1.0 + radial * s**2)
    reach = np.interp(angle, np.arctan(q) if projection == "pinhole" else q, s, right=np.nan) / math.tan(
        camera.rad_per_px
    )
    points = seen[:, :2] / np.linalg.norm(seen[:, :2], axis=1)[:, None] * reach[:, None]
    points += 0.5 * np.array([camera.width_px, camera.height_px])
    picture = 2000.0 + 20.0 * rng.standard_normal((camera.height_px, camera.width_px))
    y, x = np.mgrid[-8:9, -8:9]
    for (px, py), magnitude in zip(points, sky.magnitudes, strict=True):
        if not (8.0 < px < camera.width_px - 8.0 and 8.0 < py < camera.height_px - 8.0):
            continue
        i, j = round(camera.height_px - py - 0.5), round(px - 0.5)
        spot = np.exp(-0.5 * ((y + i - (camera.height_px - py - 0.5)) ** 2 + (x + j - (px - 0.5)) ** 2) / 1.2**2)
        flux = 20_000.0 * 10.0 ** (-0.4 * (magnitude - 6.0)) / (2.0 * math.pi * 1.2**2)
        rows, columns = np.clip(y + i, 0, camera.height_px - 1), np.clip(x + j, 0, camera.width_px - 1)
        picture[rows, columns] += flux * spot
    return np.clip(np.round(picture), 0, 65_535)


class TestWideFields:
    @pytest.mark.parametrize(
        ("name", "most_px"),
        [("wispr-20181101-inner", 0.55), ("wispr-20181101-outer", 0.55), ("wispr-20190405-inner", 0.99)],
    )
    def test_space_photographs(self, data_folder, name, most_px):
        """The centre is that of the spacecraft's star trackers, to 0.3 px, in the 2019 picture to 0.8 px."""
        folder = data_folder / "star-photographs-space"
        with (folder / "truth.csv").open() as file:
            (truth,) = (row for row in csv.DictReader(file) if row["image"] == name)
        _, found = solve_photograph(read_picture(folder / f"{name}.tiff"), adcs.hipparcos_catalogue(2018.9))
        axis = direction(float(truth["centre_ra_deg"]), float(truth["centre_dec_deg"]))
        off_rad = np.linalg.norm(-found.R_catalogue_from_frame[:, 2] - axis)
        assert off_rad / found.pose.camera.rad_per_px < most_px

    @pytest.mark.parametrize("lens", [("pinhole", 0.15), ("equidistant", 0.05), ("equidistant", -0.15)])
    def test_a_wide_lens_is_found(self, lens):
        """Field of 61° from corner to corner, 30 px of distortion in a corner; all pixels to 0.5 px, rms to 0.2."""
        camera = StarCamera(500, 480, math.radians(0.088))
        projection, radial = lens
        sky, R = random_sky(9_000), Rotation.random(random_state=20).as_matrix()
        picture = wide_photograph(sky, R, camera, projection, radial, np.random.default_rng(20))
        _, found = solve_photograph(picture, sky)
        points = np.random.default_rng(1).uniform([20, 20], [480, 460], (100, 2))
        seen = found.pose.camera.directions(points) @ found.R_catalogue_from_frame.T
        off_px = np.linalg.norm(seen - rays(points, camera, projection, radial) @ R.T, axis=1) / camera.rad_per_px
        assert math.sqrt(np.mean(off_px**2)) < 0.2
        assert off_px.max() < 0.5


class TestCommand:
    @pytest.fixture(scope="class")
    @classmethod
    def files(cls, tmp_path_factory):
        """A photograph and its catalogue."""
        folder = tmp_path_factory.mktemp("sky")
        R = Rotation.random(random_state=8).as_matrix()
        picture, _, _ = photograph(SKY, CAMERA, R, np.random.default_rng(9))
        Image.fromarray(picture.astype(np.uint16)).save(folder / "sky.png")
        ra = np.degrees(np.arctan2(SKY.directions[:, 1], SKY.directions[:, 0])) % 360.0
        columns = SKY.numbers, ra, np.degrees(np.arcsin(SKY.directions[:, 2])), SKY.magnitudes
        np.savetxt(
            folder / "sky.csv", np.column_stack(columns), "%.9g", ",", header="hip,ra_deg,dec_deg,mag", comments=""
        )
        return folder

    def test_words(self, files, capsys):
        arguments = [str(files / "sky.png"), "--catalogue", str(files / "sky.csv"), "--scale-arcsec", "61"]
        assert main(["stars", *arguments]) == 0
        line = capsys.readouterr().out
        assert ": RA " in line
        assert "mirrored" not in line
        assert float(line.split(";")[1].split()[0]) == pytest.approx(60.0, abs=0.1)

    def test_mirrored(self, files, capsys):
        """The way up is the same on the sky, and the sentence says it."""
        command = ["stars", "--catalogue", str(files / "sky.csv"), "--scale-arcsec", "61"]
        Image.fromarray(np.asarray(Image.open(files / "sky.png"))[:, ::-1]).save(files / "mirrored.png")
        assert main([*command, "--json", str(files / "sky.png"), str(files / "mirrored.png")]) == 0
        one, other = json.loads(capsys.readouterr().out)["pictures"]
        assert (one["mirrored"], other["mirrored"]) == (False, True)
        for key in ("ra_deg", "dec_deg", "roll_deg"):
            assert one[key] == pytest.approx(other[key], abs=0.02)
        assert main([*command, str(files / "mirrored.png")]) == 0
        assert "; mirrored: solved with left and right exchanged" in capsys.readouterr().out

    @pytest.mark.parametrize(
        ("arguments", "said"),
        [
            (["--scale-arcsec", "0"], "--scale-arcsec: found 0, expected a positive number"),
            (["--year", "1e9"], "--year: found 1e+09, expected 1900 to 2100"),
            (["--scale-tolerance", "0.5"], "--scale-tolerance: found 0.5, expected a positive number, 0.1 at most"),
            (["--dark", "none.png"], "none.png does not exist"),
            (["--near", "10", "-95", "3"], "--near: found the declination -95°, expected -90 to 90°"),
            (["--near", "400", "5", "3"], "--near: found the right ascension 400°, expected -360 to 360°"),
            (["--near", "10", "5", "0"], "--near: found the radius 0°, expected above 0, at most 180°"),
        ],
    )
    def test_refusals(self, files, capsys, arguments, said):
        assert main(["stars", str(files / "sky.png"), "--catalogue", str(files / "sky.csv"), *arguments]) == 2
        assert said in capsys.readouterr().err

    def test_near(self, files, capsys):
        """A right hint changes nothing; a wrong one is named."""
        arguments = ["stars", str(files / "sky.png"), "--catalogue", str(files / "sky.csv"), "--scale-arcsec", "61"]
        assert main([*arguments, "--json"]) == 0
        (row,) = json.loads(capsys.readouterr().out)["pictures"]
        ra, dec = row["ra_deg"], row["dec_deg"]
        assert main([*arguments, "--json", "--near", f"{ra - 359.5}", f"{dec}", "1"]) == 0
        (same,) = json.loads(capsys.readouterr().out)["pictures"]
        assert (same["ra_deg"], same["dec_deg"]) == pytest.approx((ra, dec), abs=1e-3)
        assert main([*arguments, "--near", f"{ra + 180.0 - 360.0 * (ra > 180.0)}", f"{-dec}", "1"]) == 0
        assert ": no fix, not solved near RA " in capsys.readouterr().out

    def test_aberration_moves_the_centre(self, files, capsys):
        """By what the Earth's velocity across the line of sight is of that of light."""
        arguments = ["stars", str(files / "sky.png"), "--catalogue", str(files / "sky.csv"), "--scale-arcsec", "61"]
        places = []
        for option in ([], ["--aberration", "--year", "2026.5"]):
            assert main([*arguments, "--json", *option]) == 0
            (row,) = json.loads(capsys.readouterr().out)["pictures"]
            places.append(direction(row["ra_deg"], row["dec_deg"]))
        across = np.cross(places[0], earth_velocity_m_s(of_julian_year(2026.5)))
        # Stars are nearer to where the Earth goes: so is the camera that sees them at the catalogue's places.
        expected = np.cross(across, places[0]) / speed_of_light
        np.testing.assert_allclose(places[1] - places[0], expected, rtol=0.0, atol=2e-7)

    def test_a_picture_that_is_not_there_leaves_nothing_written(self, files, capsys):
        pictures = [str(files / "sky.png"), str(files / "none.png")]
        catalogue = ["--catalogue", str(files / "sky.csv"), "--scale-arcsec", "61"]
        assert main(["stars", *pictures, *catalogue, "--out", str(files / "out")]) == 2
        assert "none.png does not exist" in capsys.readouterr().err
        assert not (files / "out").exists()
