"""Stages of finding the mock-up's place in the LED sky: how their cost grows, and which of them a frame consists of."""

from __future__ import annotations

import math
import pickle
from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from adcs.mockup.vision.camera import (
    Camera,
    Pose,
    camera_of_footprint,
    centred_from_table,
    distort,
    in_frame,
    undistorted,
)
from adcs.mockup.vision.centroids import find_stars
from adcs.mockup.vision.odds_matcher import OddsMatcher
from adcs.mockup.vision.paper_matcher import SLIVER_RAD, Matcher, PaperMatcher, longest_close_subset
from adcs.mockup.vision.pose_odds import PoseOdds
from adcs.mockup.vision.predicted_matcher import LightTracker
from adcs.mockup.vision.robust_matcher import RobustMatcher
from adcs.mockup.vision.similarity import fit_similarity, mirrored_image
from adcs.mockup.vision.sky import led_sky
from adcs.mockup.vision.triangles import TriangleCatalogue, delaunay_triangles
from sims.mockup.frames import rendered_frame
from tests.bench.table import Row
from tests.bench.timing import Contestant, Size, interleaved

TITLE = "mock-up: LED sky, n lights and f stars in view, 1 thread"
POSE = Pose(0.1, -0.2, 0.7)
TOLERANCE_RAD = math.radians(0.5)


def rows(size: Size) -> Iterator[Row]:
    """Times a stage at one size, and at four times the size as its peer, so that the ratio is the growth."""
    lights = (180, 720, 2880) if size.rows > 100 else (180, 720)
    catalogues = {n: wide_catalogue(n) for n in lights}
    yield from _delaunay_rows(catalogues[lights[-1]], size)
    yield from _search_rows(catalogues, size)
    yield from _validation_rows(catalogues[lights[-1]], size)
    yield from _memory_rows(catalogues)
    yield from _identification_rows(catalogues, size)
    yield from _frame_rows(size)


def _delaunay_rows(catalogue: TriangleCatalogue, size: Size) -> Iterator[Row]:
    """Triangles of an image, O(f lg f)."""
    images = [stars_of(catalogue, camera_of_footprint(width)) for width in (0.9, 1.8, 3.6)]
    timings = interleaved({i: Contestant(lambda p=p: delaunay_triangles(p)) for i, p in enumerate(images)}, size.rounds)
    for i in range(len(images) - 1):
        f, more = len(images[i]), len(images[i + 1])
        expected = more * math.log(more) / (f * math.log(f))
        note = f"f lg f grows {expected:.1f} times"
        yield Row(f"image triangles, f = {f}", timings[i], f"f = {more}", timings[i + 1], note)


def _search_rows(catalogues: dict[int, TriangleCatalogue], size: Size) -> Iterator[Row]:
    """All against all, O(f n), and the same question asked of the k-d tree; first by n, then by f."""
    largest = catalogues[max(catalogues)]
    one, four = (delaunay_triangles(stars_of(largest, camera_of_footprint(width)), SLIVER_RAD) for width in (1.8, 3.6))
    contestants = {}
    for n, catalogue in catalogues.items():
        for triangles in (one, four):
            key = n, len(triangles)
            contestants[*key, "all"] = Contestant(lambda c=catalogue, t=triangles: PaperMatcher(c).matches(t))
            contestants[*key, "tree"] = Contestant(
                lambda c=catalogue, t=triangles: c.angle_tree.query_ball_point(t.angles_rad, TOLERANCE_RAD, p=math.inf)
            )
    timings = interleaved(contestants, size.rounds)
    for (n, f), (more_n, more_f) in (
        *pairwise((n, len(one)) for n in catalogues),
        ((max(catalogues), len(one)), (max(catalogues), len(four))),
    ):
        growth = {
            "all": f"f n grows {more_n * more_f / (n * f):.1f} times",
            "tree": f"f lg n grows {more_f * math.log(more_n) / (f * math.log(n)):.1f} times, beside the matches",
        }
        for way, what in (("all", "all against all"), ("tree", "k-d tree")):
            yield Row(
                f"search {what}, {f} of {2 * n}",
                timings[n, f, way],
                f"{more_f} of {2 * more_n}",
                timings[more_n, more_f, way],
                growth[way],
            )
    for n in catalogues:
        yield Row(
            f"search k-d tree, {len(one)} of {2 * n}",
            timings[n, len(one), "tree"],
            "all against all",
            timings[n, len(one), "all"],
            "the same triangles",
        )


def _validation_rows(catalogue: TriangleCatalogue, size: Size) -> Iterator[Row]:
    """Centres of the c pairs of triangles that match, O(c), and the longest list of close ones.

    All distances are O(c²), as is a list around one centre. Where the spread of the true centres nears what counts as
    close, as in the widest image, a list is made around most of them: O(c³).
    """
    candidates = []
    for width in (0.9, 1.8, 3.6) if size.rows > 100 else (0.9, 1.8):
        image = stars_of(catalogue, camera_of_footprint(width))
        triangles = delaunay_triangles(image, SLIVER_RAD)
        mine, theirs = PaperMatcher(catalogue).matches(triangles)
        seen, known = image[triangles.corners[mine]], catalogue.plane[catalogue.triangles.corners[theirs]]
        candidates.append((seen, known))
    contestants = {}
    for seen, known in candidates:
        centres = fit_similarity(seen, known)[1]
        contestants["centres", len(seen)] = Contestant(lambda p=seen, q=known: fit_similarity(p, q))
        contestants["validation", len(seen)] = Contestant(
            lambda b=centres: longest_close_subset(b, PaperMatcher(catalogue).closeness_m)
        )
    timings = interleaved(contestants, size.rounds)
    for stage, law in (("centres", "c grows {0:.1f} times"), ("validation", "c² grows {1:.1f} times, c³ {2:.1f}")):
        for c, more in pairwise(len(seen) for seen, _ in candidates):
            growth = more / c
            note = law.format(growth, growth**2, growth**3)
            yield Row(f"{stage}, c = {c}", timings[stage, c], f"c = {more}", timings[stage, more], note)


def _memory_rows(catalogues: dict[int, TriangleCatalogue]) -> Iterator[Row]:
    """Size of a catalogue, O(n)."""
    for n, catalogue in catalogues.items():
        n_bytes = len(pickle.dumps((catalogue.positions_m, catalogue.triangles)))
        yield Row(
            f"memory of the catalogue, n = {n}", note=f"{n_bytes / 1024:.0f} KiB, {n_bytes / n:.0f} bytes a light"
        )


def _identification_rows(catalogues: dict[int, TriangleCatalogue], size: Size) -> Iterator[Row]:
    """Whole identification of a good image."""
    contestants = {}
    for n, catalogue in catalogues.items():
        points = centred_stars(catalogue, Camera())
        for name, matcher in matchers(catalogue).items():
            contestants[n, name] = Contestant(lambda m=matcher, p=points: m.identify(p))
    timings = interleaved(contestants, size.rounds)
    for n in catalogues:
        for name in ("robust", "odds"):
            yield Row(f"identification, {name}, n = {n}", timings[n, name], "paper", timings[n, "paper"])


def _frame_rows(size: Size) -> Iterator[Row]:
    """A frame of 640 × 480 pixels, from the image to the fix."""
    sky, camera = led_sky(0), Camera()
    image = rendered_frame(sky, camera, POSE, np.random.default_rng(0)).image
    points = undistorted(camera, find_stars(image).positions_px)
    contestants = {"centroids": Contestant(lambda: find_stars(image))}
    catalogue = TriangleCatalogue.of(sky.positions_m)
    for name, matcher in matchers(catalogue).items():
        contestants[f"identification, {name}"] = Contestant(lambda m=matcher: m.identify(points))
    tracker, covariance = LightTracker(PoseOdds.of(catalogue, camera)), np.diag([0.01, 0.01, 0.005]) ** 2
    contestants["tracking"] = Contestant(lambda: tracker.identify_near(points, POSE, covariance))
    timings = interleaved(contestants, size.rounds)
    for name in list(contestants)[1:]:
        yield Row(f"frame: {name}", timings[name], "centroids", timings["centroids"])


def matchers(catalogue: TriangleCatalogue) -> dict[str, Matcher]:
    """The three, for a camera of 0.9 m."""
    return {
        "paper": PaperMatcher(catalogue),
        "robust": RobustMatcher(catalogue, Camera().m_per_px),
        "odds": OddsMatcher.of(catalogue, Camera()),
    }


def wide_catalogue(n: int) -> TriangleCatalogue:
    """Lights as dense as those of the 180-light sky, 0.2 m apart on average and 7 cm at least, around the origin."""
    columns = math.ceil(math.sqrt(n))
    rng = np.random.default_rng(n)
    grid = np.stack(np.divmod(np.arange(n), columns), axis=1) - 0.5 * columns
    return TriangleCatalogue.of(0.2 * grid + rng.uniform(-0.065, 0.065, (n, 2)))


def centred_stars(catalogue: TriangleCatalogue, camera: Camera) -> np.ndarray:
    """Centred pixels of the lights that the camera sees, with a tenth of a pixel of noise."""
    points = centred_from_table(camera, POSE, catalogue.positions_m)
    seen = points[in_frame(camera, distort(camera, points), 5.0)]
    return seen + 0.1 * np.random.default_rng(1).standard_normal(seen.shape)


def stars_of(catalogue: TriangleCatalogue, camera: Camera) -> np.ndarray:
    """The same as mirrored complex numbers."""
    return mirrored_image(centred_stars(catalogue, camera))
