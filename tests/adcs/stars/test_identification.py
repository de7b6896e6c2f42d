"""Stars of the real sky.

What is checked                  by what
identification                   random skies of which the truth is known; recorded frames: test_pictures.py
the image's handedness           three bright stars of Cepheus, from any almanac
the compiled search              every pair of triangles, checked by a k-d tree
pose and covariance              the truth, whitened by the covariance (NEES); the exact pose without noise
"""

import json
import math
import re
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.spatial.transform import Rotation

from adcs.stars.camera import StarCamera
from adcs.stars.catalogue import StarCatalogue
from adcs.stars.files import read_star_frames
from adcs.stars.identification import NoFix, StarFix, StarMatcher, identify_stars
from adcs.stars.pose import UNKNOWN_LENS, CameraPose, fit_pose
from adcs.stars.triangles import KEPT, Checks, RankedTriangles, TriangleIndex, star_triangles
from arrays.io.errors import InputError
from tests.adcs.refusals import assert_refused

CAMERA = StarCamera(1392, 1040, math.radians(15.78 / 3600.0))
NOISE_PX = 0.8


def random_sky(n, seed=0):
    """Stars in random directions, three times as many with every magnitude."""
    rng = np.random.default_rng(seed)
    ra, dec = rng.uniform(0.0, 2.0 * math.pi, n), np.arcsin(rng.uniform(-1.0, 1.0, n))
    return StarCatalogue.of(np.arange(1, n + 1), ra, dec, 10.0 + np.log(rng.random(n)) / math.log(3.0))


def image_of(sky, R, rng, lost=0.05, false=3, camera=CAMERA):
    """Points, magnitudes and rows of the stars that a camera of that attitude sees, and -1 of stars that are none."""
    seen = sky.directions @ R
    front = seen[:, 2] < 0.0
    with np.errstate(divide="ignore", invalid="ignore"):
        points = seen[:, :2] / -seen[:, 2:] / math.tan(camera.rad_per_px)
    points = points + 0.5 * np.array([camera.width_px, camera.height_px])
    inside = front & (points > 0.0).all(axis=1) & (points < [camera.width_px, camera.height_px]).all(axis=1)
    rows = np.flatnonzero(inside & (rng.random(len(seen)) >= lost))
    noisy = points[rows] + NOISE_PX * rng.standard_normal((len(rows), 2))
    clutter = rng.uniform([0, 0], [camera.width_px, camera.height_px], (false, 2))
    magnitudes = np.concatenate([sky.magnitudes[rows] + 0.2 * rng.standard_normal(len(rows)), rng.uniform(6, 9, false)])
    return np.concatenate([noisy, clutter]), magnitudes, np.concatenate([rows, np.full(false, -1)])


class TestRandomSky:
    @pytest.mark.slow
    def test_stars_are_identified(self):
        """30,000 stars, 20 in an image, with noise in places and magnitudes, 5 % lost and three false ones."""
        sky, rng = random_sky(30_000), np.random.default_rng(1)
        matcher = StarMatcher.of(sky, CAMERA)
        right = identified = there = 0
        for R in Rotation.random(20, random_state=2).as_matrix():
            points, magnitudes, rows = image_of(sky, R, rng)
            fix = matcher.identify(points, magnitudes)
            assert isinstance(fix, StarFix)
            # Across the axis to a fraction of a pixel; about it to that at the image's border, 500 px away.
            assert np.linalg.norm(fix.R_catalogue_from_frame[:, 2] - R[:, 2]) < 2.0 * CAMERA.rad_per_px
            assert Rotation.from_matrix(fix.R_catalogue_from_frame @ R.T).magnitude() < 2.0 / 500.0
            right += np.count_nonzero(rows[fix.stars[:, 0]] == fix.stars[:, 1])
            identified += len(fix.stars)
            there += np.count_nonzero(rows >= 0)
        assert right / there > 0.98
        assert right / identified > 0.995

    def test_an_unknown_sky_gives_no_fix(self):
        matcher, rng = StarMatcher.of(random_sky(30_000), CAMERA), np.random.default_rng(3)
        other = random_sky(30_000, seed=4)
        for R in Rotation.random(20, random_state=5).as_matrix():
            points, magnitudes, _ = image_of(other, R, rng)
            assert isinstance(matcher.identify(points, magnitudes), NoFix)

    @pytest.mark.parametrize("n", [1, pytest.param(4, marks=pytest.mark.slow)])
    def test_a_mirrored_image_is_named(self, n):
        """The matcher alone finds nothing; among images each is tried both ways."""
        sky, rng = random_sky(30_000), np.random.default_rng(6)
        matcher = StarMatcher.of(sky, CAMERA)
        for R in Rotation.random(n, random_state=7).as_matrix():
            points, magnitudes, _ = image_of(sky, R, rng)
            mirrored = points * [-1.0, 1.0] + [1392.0, 0.0]
            assert isinstance(matcher.identify(mirrored, magnitudes), NoFix)
            fixes = identify_stars(sky, CAMERA, [(points, magnitudes), (mirrored, magnitudes)])
            assert [fix.mirrored for fix in fixes] == [False, True]
            assert_array_equal(fixes[0].stars, fixes[1].stars)
            assert_allclose(fixes[0].R_catalogue_from_frame, fixes[1].R_catalogue_from_frame, atol=1e-9)

    def test_turning_the_sky_turns_the_attitude(self):
        sky, rng = random_sky(30_000), np.random.default_rng(8)
        R, turn = Rotation.random(2, random_state=9).as_matrix()
        points, magnitudes, _ = image_of(sky, R, rng)
        before = StarMatcher.of(sky, CAMERA).identify(points, magnitudes)
        turned = StarCatalogue(sky.numbers, sky.directions @ turn.T, sky.magnitudes)
        order = rng.permutation(len(points))
        after = StarMatcher.of(turned, CAMERA).identify(points[order], magnitudes[order])
        assert_allclose(after.R_catalogue_from_frame, turn @ before.R_catalogue_from_frame, atol=1e-9)
        assert {(order[i], j) for i, j in after.stars} == {tuple(pair) for pair in before.stars}

    @pytest.mark.parametrize("n", [0, 1, 3])
    def test_too_few_stars(self, n):
        fix = StarMatcher.of(random_sky(1000), CAMERA).identify(np.zeros((n, 2)), np.zeros(n))
        assert fix == NoFix(f"{n} stars, 4 needed")


class TestGeometry:
    def test_triangles_have_brighter_corners_and_do_not_depend_on_fainter_stars(self):
        directions = random_sky(3000).directions
        few, many = star_triangles(directions[:500], 0.3, 4), star_triangles(directions, 0.3, 4)
        known = {frozenset(corners) for corners in many.corners.tolist()}
        # Fainter stars may crowd brighter neighbours out of the nearest 24, no more.
        assert np.mean([frozenset(corners) in known for corners in few.corners.tolist()]) > 0.2
        assert (np.diff(many.sides, axis=1) >= 0.0).all()
        assert many.sides.max() <= 0.3

    @pytest.mark.parametrize("sizes", [(1500,), (700, 1500), (3000, 1500)])
    def test_ranked_triangles_are_those_of_the_nearest_brighter_stars(self, sizes):
        """All pairs of stars say which are nearest; of 16 neighbours fewer than 4 are brighter for 1 % of the stars."""
        directions, ranked = random_sky(3000).directions, RankedTriangles(random_sky(3000).directions, 4)
        for n in sizes:
            found = ranked.of_brightest(n, 0.3)
        known = {frozenset(corners) for corners in found.corners.tolist()}
        assert len(known) == len(found.corners)
        assert found.sides.max() <= 0.3
        expected = set()
        for i in range(4, 1500):
            nearest = np.argsort(-directions[:i] @ directions[i])[:4]
            for pair in combinations(nearest.tolist(), 2):
                corners = directions[[i, *pair]]
                if max(np.linalg.norm(corners - np.roll(corners, 1, axis=0), axis=1)) <= 0.3:
                    expected.add(frozenset((i, *pair)))
        assert len(known & expected) > 0.97 * len(expected)
        assert len(known - expected) < 0.03 * len(expected)

    def test_stars_at_one_place_make_no_triangle(self):
        directions = np.tile([1.0, 0.0, 0.0], (10, 1))
        assert not len(star_triangles(directions, 0.3, 4).sides)
        assert not len(TriangleIndex.of(RankedTriangles(directions, 4), 10, 0.3).triangles.sides)

    @pytest.mark.parametrize(
        ("camera", "text"),
        [
            ((1392, 1040, 1e-170), "must be 0.01 to 3600 arc seconds"),
            ((1392, 1040, 1e300), "must be 0.01 to 3600 arc seconds"),
            ((10**6, 1040, 1e-5), "at most 100000"),
            ((9000, 9000, 1e-2), "at most 150° wide"),
            ((0, 9000, 1e-2), "must be positive"),
        ],
    )
    def test_no_camera(self, camera, text):
        with pytest.raises(ValueError, match=text):
            StarCamera(*camera)

    @pytest.mark.parametrize("points", [[1.0, 2.0], [[1.0, 2.0, 3.0]], [[np.nan, 0.0]]])
    def test_no_points(self, points):
        with pytest.raises(ValueError, match="Input points_px must be finite numbers of shape"):
            CAMERA.directions(points)


def hypotheses(index, tangents, image, checks):
    """Rotations (h, 3, 3) and relative scales (h,) of all pairs of triangles that agree: what the search tries."""
    known, longest = index.triangles, image.sides[:, 2:]
    gate = checks.side / longest
    off = image.sides[:, None, :2] / longest[:, None] - known.sides[:, :2] / known.sides[:, 2:]
    agree = (off**2).sum(axis=-1) <= gate**2
    agree &= np.abs(known.sides[:, 2] - longest) <= checks.scale * longest + checks.side
    agree &= image.is_counter_clockwise[:, None] == known.is_counter_clockwise
    i, k = np.nonzero(agree)
    scale = np.clip(known.sides[k].sum(axis=1) / image.sides[i].sum(axis=1), 1.0 - checks.scale, 1.0 + checks.scale)
    seen = scale[:, None, None] * tangents[image.corners[i]]
    seen = np.concatenate([seen, np.full((*seen.shape[:2], 1), -1.0)], axis=2)
    seen /= np.linalg.norm(seen, axis=2, keepdims=True)
    return np.swapaxes(triangle_axes(index.bright[known.corners[k]]), 1, 2) @ triangle_axes(seen), scale


def triangle_axes(corners):
    """Axes (h, 3, 3), in rows, of triangles (h, 3, 3): the longest side, the middle across it, and the third."""
    along = corners[:, 1] - corners[:, 0]
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    middle = corners.sum(axis=1)
    middle -= np.sum(middle * along, axis=1, keepdims=True) * along
    middle /= np.linalg.norm(middle, axis=1, keepdims=True)
    return np.stack([along, middle, np.cross(along, middle)], axis=1)


class TestCompiledSearch:
    @pytest.mark.usefixtures("instruction_set")
    @pytest.mark.parametrize("scale", [0.0, 0.05])
    def test_is_that_of_all_pairs_of_triangles(self, scale):
        """Of a small sky, all that match by chance too: the best are those of a k-d tree."""
        sky, camera, rng = random_sky(2000), StarCamera(600, 400, math.radians(0.05)), np.random.default_rng(20)
        points, magnitudes, _ = image_of(sky, Rotation.random(random_state=21).as_matrix(), rng, camera=camera)
        points = points[np.argsort(magnitudes)]
        tangents = camera.tangents(points)
        index = TriangleIndex.of(RankedTriangles(sky.directions[np.argsort(sky.magnitudes)], 4), 1000, 1.0)
        image = star_triangles(camera.directions(points[:20]), 2.0, 4)
        checks = Checks(0.02, scale, 0.01, 15, 1000, 10**9)
        R, factor = hypotheses(index, tangents, image, checks)
        scaled = factor[:, None, None] * tangents[:15]
        scaled = np.concatenate([scaled, np.full((*scaled.shape[:2], 1), -1.0)], axis=2)
        scaled /= np.linalg.norm(scaled, axis=2, keepdims=True)
        distance = sky.tree.query(scaled @ np.swapaxes(R, 1, 2))[0]
        matched = np.count_nonzero(distance < checks.near, axis=1)
        (found,) = index.best(tangents, image, sky.cells, checks)
        assert len(found) == KEPT
        assert found[0].tried == len(R) > 300
        expected = np.sort(matched)[: -KEPT - 1 : -1]
        for hypothesis, count in zip(found, expected, strict=True):
            same = np.flatnonzero(np.abs(R - hypothesis.R).max(axis=(1, 2)) < 1e-9)
            assert matched[same].max() == count
            assert np.abs(factor[same] - hypothesis.scale).min() < 1e-12


class TestPose:
    LENS = StarCamera(1392, 1040, math.radians(15.78 / 3600.0), radial=-2.0)

    def points(self, R, rng, noise_px):
        """Stars of a camera whose lens bends by 2 px at a corner: its model inverted by iteration."""
        directions, camera = random_sky(40_000).directions, self.LENS
        seen = directions @ R
        tangents = seen[:, :2] / -seen[:, 2:]
        inside = (seen[:, 2] < 0.0) & (np.abs(tangents) < 0.95 * camera.corner * np.array([0.8, 0.6])).all(axis=1)
        tangents = tangents[inside]
        pinhole = tangents
        for _ in range(20):
            pinhole = tangents / (1.0 + camera.radial * np.sum(pinhole**2, axis=1, keepdims=True))
        points = pinhole / math.tan(camera.rad_per_px) + [696.0, 520.0]
        return points + noise_px * rng.standard_normal(points.shape), directions[inside]

    def fit(self, R, rng, noise_px):
        points, there = self.points(R, rng, noise_px)
        known = StarCamera(1392, 1040, 1.02 * CAMERA.rad_per_px)
        pose = CameraPose(R @ Rotation.from_rotvec([1e-3, -1e-3, 2e-3]).as_matrix(), known, np.zeros((8, 8)))
        for _ in range(5):
            pose = fit_pose(points, there, pose, known, UNKNOWN_LENS, max(noise_px, 1e-6))
        return pose

    def test_is_exact_without_noise(self):
        R = Rotation.random(random_state=30).as_matrix()
        pose = self.fit(R, np.random.default_rng(0), 0.0)
        assert_allclose(pose.R_catalogue_from_frame, R, atol=1e-10)
        assert pose.camera.rad_per_px == pytest.approx(self.LENS.rad_per_px, rel=1e-9)
        assert pose.camera.radial == pytest.approx(-2.0, rel=1e-6)

    def test_covariance(self):
        """NEES of 60 poses over 5 states: χ²(300) is within 240 to 360 but for 1 % of seeds."""
        rng, total = np.random.default_rng(31), 0.0
        for R in Rotation.random(60, random_state=32).as_matrix():
            pose = self.fit(R, rng, 0.3)
            turn = Rotation.from_matrix(R.T @ pose.R_catalogue_from_frame).as_rotvec()
            scale = math.log(pose.camera.rad_per_px / self.LENS.rad_per_px)
            error = np.array([*turn, scale, pose.camera.radial + 2.0])
            total += error @ np.linalg.solve(pose.covariance[:5, :5], error)
        # The scatter of the residuals is estimated too, of some 40 numbers: Student's tails add a tenth.
        assert 240.0 < total < 1.1 * 360.0


@pytest.fixture(scope="module")
def frames(data_folder):
    return read_star_frames(data_folder / "star-frames")


class TestRecordedFrames:
    """50 frames with labels; identified with Hipparcos in test_pictures.py."""

    def test_handedness_and_scale(self, frames):
        """ζ, δ and ε Cephei (Hipparcos 109492, 110991, 109857), J2000, to the second."""
        camera, images = frames
        image = next(image for image in images if {109492, 110991, 109857} <= set(image.numbers.tolist()))
        ra = np.radians(
            [15.0 * (22 + 10 / 60 + 51 / 3600), 15.0 * (22 + 29 / 60 + 10 / 3600), 15.0 * (22 + 15 / 60 + 2 / 3600)]
        )
        dec = np.radians([58 + 12 / 60 + 5 / 3600, 58 + 24 / 60 + 55 / 3600, 57 + 2 / 60 + 37 / 3600])
        sky = np.stack([np.cos(dec) * np.cos(ra), np.cos(dec) * np.sin(ra), np.sin(dec)], axis=1)
        rows = [int(np.flatnonzero(image.numbers == number)[0]) for number in (109492, 110991, 109857)]
        seen = camera.directions(image.points_px[rows])
        R = Rotation.align_vectors(sky, seen)[0].as_matrix()
        assert np.linalg.norm(seen @ R.T - sky, axis=1).max() < 3.0 * camera.rad_per_px
        mirrored = seen * [-1.0, 1.0, 1.0]
        R = Rotation.align_vectors(sky, mirrored)[0].as_matrix()
        assert np.linalg.norm(mirrored @ R.T - sky, axis=1).max() > 100 * camera.rad_per_px


def write_frames(folder, sky, attitudes, rng):
    folder.mkdir()
    (folder / "calibration.txt").write_text("IMG_X=1392\nIMG_Y=1040\nPIXSCALE=15.78\nOTHER=anything\n")
    images = [image_of(sky, R, rng) for R in attitudes]
    rows = [np.column_stack([points, magnitudes]).ravel() for points, magnitudes, _ in images]
    (folder / "input.csv").write_text("".join(",".join(f"{value:.6f}" for value in row) + ",\n" for row in rows))
    labels = [np.where(row >= 0, sky.numbers[row], -1) for *_, row in images]
    (folder / "result.csv").write_text("".join(",".join(map(str, row)) + "\n" for row in labels))


@pytest.fixture(scope="module")
def sky_files(tmp_path_factory):
    folder = tmp_path_factory.mktemp("stars")
    sky = random_sky(30_000)
    ra, dec = (
        np.degrees(np.arctan2(sky.directions[:, 1], sky.directions[:, 0])) % 360.0,
        np.degrees(np.arcsin(sky.directions[:, 2])),
    )
    lines = [f"{n},{a:.9f},{d:.9f},{m:.3f}\n" for n, a, d, m in zip(sky.numbers, ra, dec, sky.magnitudes, strict=True)]
    (folder / "sky.csv").write_text("hip,ra_deg,dec_deg,mag\n" + "".join(lines))
    write_frames(folder / "frames", sky, Rotation.random(3, random_state=1).as_matrix(), np.random.default_rng(2))
    return folder


class TestCommand:
    def test_says_where_and_how_many(self, adcs, sky_files):
        outcome = adcs("stars", sky_files / "frames", "--catalogue", sky_files / "sky.csv")
        assert outcome.status == 0, outcome.err
        *lines, last = outcome.out.splitlines()
        directions = -Rotation.random(3, random_state=1).as_matrix()[:, :, 2]
        for line, (x, y, z) in zip(lines, directions, strict=True):
            ra, dec = map(float, re.findall(r"RA ([\d.]+)°, Dec ([-+\d.]+)°", line)[0])
            assert ra == pytest.approx(math.degrees(math.atan2(y, x)) % 360.0, abs=0.02)
            assert dec == pytest.approx(math.degrees(math.asin(z)), abs=0.02)
        assert last.startswith("3 fixes")

    def test_json(self, adcs, sky_files):
        outcome = adcs("stars", sky_files / "frames", "--catalogue", sky_files / "sky.csv", "--json")
        found = json.loads(outcome.out)
        assert found["fixes"] == len(found["frames"]) == 3
        assert found["identification_rate"] > 0.95
        assert found["false_rate"] < 0.05
        R = Rotation.random(3, random_state=1).as_matrix()[0]
        north = np.array([0.0, 0.0, 1.0]) + R[2, 2] * R[:, 2] * -1.0
        east = np.cross(north, -R[:, 2])
        roll = math.degrees(math.atan2(R[:, 1] @ east, R[:, 1] @ north))
        assert abs(math.remainder(found["frames"][0]["roll_deg"] - roll, 360.0)) < 0.05

    def test_without_labels(self, adcs, sky_files, tmp_path):
        for name in ("calibration.txt", "input.csv"):
            (tmp_path / name).write_text((sky_files / "frames" / name).read_text())
        outcome = adcs("stars", tmp_path, "--catalogue", sky_files / "sky.csv")
        assert outcome.out.splitlines()[-1].endswith("stars identified")

    @pytest.mark.parametrize(
        ("text", "fragments"),
        [
            ("hip,ra_deg,mag\n1,2,3\n", ["column dec_deg", "found no such column"]),
            ("hip,ra_deg,dec_deg,mag\n1,2,95,3\n", ["line 2, column dec_deg", "declination beyond 90°"]),
            ("hip,ra_deg,dec_deg,mag\n1,2,north,3\n", ["line 2, column dec_deg"]),
            ("hip,ra_deg,dec_deg,mag\n1.5,2,5,3\n", ["line 2, column hip", "expected a whole number"]),
            ("hip,ra_deg,dec_deg,mag\n1,2,5,3\n1,3,5,3\n", ["line 3, column hip", "expected every value once"]),
            ("hip,ra_deg,dec_deg,mag\n1e30,2,5,3\n", ["line 2, column hip: found 1e+30, expected a number from 0"]),
            ("hip,ra_deg,dec_deg,mag\n1,2,5,3\n-1,3,5,3\n", ["line 3, column hip: found -1, expected a number from 0"]),
            ("hip,ra_deg,dec_deg,mag\n1,2,5,3\n", ["found 1 stars, expected 4 at least"]),
        ],
    )
    def test_bad_catalogues(self, adcs, sky_files, tmp_path, text, fragments):
        (tmp_path / "bad.csv").write_text(text)
        assert_refused(adcs("stars", sky_files / "frames", "--catalogue", tmp_path / "bad.csv"), "bad.csv", *fragments)

    @pytest.mark.parametrize(
        ("name", "text", "fragments"),
        [
            ("calibration.txt", "IMG_X=10\nIMG_Y=10\n", ["found no line PIXSCALE="]),
            ("calibration.txt", "IMG_X=-1\nIMG_Y=10\nPIXSCALE=1\n", ["line 1: found IMG_X=-1, expected a positive"]),
            (
                "calibration.txt",
                "IMG_X=0.5\nIMG_Y=10\nPIXSCALE=1\n",
                ["line 1: found IMG_X=0.5, expected a positive whole number"],
            ),
            ("calibration.txt", "IMG_X=9\nIMG_Y=9\nPIXSCALE=4e5\n", ["found PIXSCALE=4e5", "0.01 to 3600"]),
            (
                "calibration.txt",
                "IMG_X=1e300\nIMG_Y=9\nPIXSCALE=9\n",
                ["line 1: found IMG_X=1e300", "1 to 100000 pixels"],
            ),
            (
                "calibration.txt",
                "IMG_X=900\nIMG_Y=1200\nPIXSCALE=3000\n",
                ["found PIXSCALE=3000 for 1500 pixels", "150°"],
            ),
            ("input.csv", "1,2,3,4\n", ["line 1: found 4 numbers, expected three for each star"]),
            ("input.csv", "1,2,x\n", ["line 1: found 'x', expected a finite number"]),
            ("input.csv", "1,1e300,3\n", ["line 1: found '1e300', expected a finite number"]),
            ("input.csv", "\n", ["found no frame, expected one at least"]),
            ("result.csv", "1,2\n", ["found 1 frames, expected 3"]),
            ("result.csv", "1\n1\n1\n", ["line 1: found 1 numbers"]),
        ],
    )
    def test_bad_frames(self, adcs, sky_files, tmp_path, name, text, fragments):
        for other in ("calibration.txt", "input.csv", "result.csv"):
            (tmp_path / other).write_text((sky_files / "frames" / other).read_text())
        (tmp_path / name).write_text(text)
        outcome = adcs("stars", tmp_path, "--catalogue", sky_files / "sky.csv")
        assert_refused(outcome, name, *fragments)

    @pytest.mark.parametrize(
        ("label", "sentence"),
        [
            ("1e30", f"found {1e30:.15g}, expected numbers of stars"),
            ("-2", "found -2, expected numbers of stars"),
            ("0.5", "found a fraction, expected whole numbers"),
        ],
    )
    def test_labels_that_are_no_numbers_of_stars(self, adcs, sky_files, tmp_path, label, sentence):
        for name in ("calibration.txt", "input.csv", "result.csv"):
            (tmp_path / name).write_text((sky_files / "frames" / name).read_text())
        labels = (tmp_path / "result.csv").read_text()
        (tmp_path / "result.csv").write_text(labels.replace(labels.split(",")[0], label, 1))
        assert_refused(adcs("stars", tmp_path, "--catalogue", sky_files / "sky.csv"), f"result.csv, line 1: {sentence}")

    def test_no_such_folder(self, adcs, sky_files, tmp_path):
        assert_refused(adcs("stars", tmp_path / "none", "--catalogue", sky_files / "sky.csv"), "does not exist")

    @pytest.mark.parametrize(("options", "scale"), [((), 0.0), (("--scale-tolerance", "0.02"), 0.02)])
    def test_the_tolerance_is_the_error_of_the_scale(self, adcs, sky_files, monkeypatch, options, scale):
        def identify(*_, lens, **others):
            assert lens.scale == scale
            assert (lens.bent > 0.0) == (scale > 0.0)
            raise InputError("seen")

        monkeypatch.setattr("adcs.identify_stars", identify)
        assert_refused(adcs("stars", sky_files / "frames", "--catalogue", sky_files / "sky.csv", *options), "seen")

    def test_noise_must_be_positive(self, adcs, sky_files):
        outcome = adcs("stars", sky_files / "frames", "--catalogue", sky_files / "sky.csv", "--noise-px", "0")
        assert_refused(outcome, "--noise-px", "expected a positive number")

    @pytest.mark.parametrize("noise", ["105", "1e308"])
    def test_noise_as_large_as_the_image(self, adcs, sky_files, noise):
        outcome = adcs("stars", sky_files / "frames", "--catalogue", sky_files / "sky.csv", "--noise-px", noise)
        assert_refused(outcome, "--noise-px", "expected at most 104, a tenth of the image's shorter side")

    def test_noise_in_which_most_triangles_agree_is_no_long_work(self, adcs, sky_files):
        outcome = adcs(
            "stars", sky_files / "frames", "--catalogue", sky_files / "sky.csv", "--noise-px", "50", "--json"
        )
        found = json.loads(outcome.out)
        assert found["fixes"] == 0
        assert all("stars too easily" in frame["reason"] for frame in found["frames"])


def test_a_folder_that_is_none(tmp_path):
    with pytest.raises(InputError, match="does not exist"):
        read_star_frames(Path(tmp_path) / "nothing")
