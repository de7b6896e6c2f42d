"""Estimate of a source from rows that are individually insufficient."""

from __future__ import annotations

from collections import deque
from dataclasses import replace

import numpy as np

from magloc.tracking.chart.mixture import Mixture, root_of
from magloc.tracking.chart.places import ENOUGH, Places, effective_sample_size, sample_places
from magloc.tracking.chart.stack import Stack, displacement
from magloc.tracking.chart.steps import ChartFilter
from magloc.tracking.measurement import RowMeasurement
from magloc.tracking.motion import N_SOURCE, MotionModel, RandomWalk

MOST_ROWS = 256
"""Largest number of rows, the latest, that are combined."""
REFITS_GROW = 1.03
"""Growth of the number of rows between two fits; between them, the estimate is predicted."""
SEARCHES_GROW = 1.4
"""Growth of the number of rows between two searches on the grid of the start."""
_AT_REST = RandomWalk(0.0, 0.0)
# Length of a moment: as many differences do not determine a place.
_OF_A_MOMENT = 3


class Undetermined:
    """Rows that show a source, and their common estimate of it."""

    def __init__(self, chart_filter: ChartFilter) -> None:
        self.filter = chart_filter
        self.forget()

    def forget(self) -> None:
        """Discard all rows."""
        self._rows: deque[RowMeasurement] = deque(maxlen=MOST_ROWS)
        self._mixture: Mixture | None = None
        self._n_rows, self._next_fit, self._next_search = 0, 2, 2

    @property
    def position_error(self) -> float:
        """Standard deviation of the position over the range; 0 without an estimate."""
        if self._mixture is None:
            return 0.0
        mean, covariance = self._mixture.moments()
        distance = float(np.linalg.norm(mean[:3] - self._mixture.centroid_m))
        return float(np.sqrt(np.trace(covariance[:3, :3]))) / distance if distance > 0.0 else np.inf

    def after(self, row: RowMeasurement, motion: MotionModel) -> tuple[Mixture | None, str]:
        """Return the mixture after one more row, or None and the reason."""
        is_detected = self.filter.is_detected(row)
        if is_detected or self._rows:
            self._add(row, motion)
        if not is_detected or self._mixture is None:
            return self.filter.row_mixture(row, motion)
        return self._mixture, ""

    def _add(self, row: RowMeasurement, motion: MotionModel) -> None:
        """Add one row, and fit again if there are enough new ones."""
        if not row.n_differences or _moves_a_source_at_rest(motion):
            return
        if self._mixture is not None and self._rows:
            self._mixture = _predict(self._mixture, row, motion, row.row.time_s - self._rows[-1].row.time_s)
        self._rows.append(row)
        self._n_rows += 1
        if self._n_rows >= self._next_fit:
            self._next_fit = int(np.ceil(REFITS_GROW * self._n_rows))
            self._fit(Stack.of(tuple(self._rows), self.filter.errors, self.filter.pose_errors, motion))

    def _fit(self, stack: Stack) -> None:
        """Sample places from the last estimate, and from a search if necessary."""
        if stack.n_differences <= _OF_A_MOMENT:
            return
        places = [] if self._mixture is None else [Places.about(self._mixture)]
        mixture = sample_places(stack, places, self.filter.prior) if self._n_rows < self._next_search else None
        if mixture is None or effective_sample_size(mixture) < ENOUGH:
            self._next_search = int(np.ceil(SEARCHES_GROW * self._n_rows))
            found, _ = self.filter.stack_mixture(stack, _AT_REST)
            if found is not None:
                places.append(Places.of(found))
            mixture = sample_places(stack, places, self.filter.prior)
        self._mixture = mixture
        if mixture is None:
            # The rows contradict each other: fewer rows tolerate a motion that differs from the model.
            for _ in range(len(self._rows) // 2):
                self._rows.popleft()
            self._n_rows = len(self._rows)
            self._next_fit = self._next_search = self._n_rows + 1


def _moves_a_source_at_rest(motion: MotionModel) -> bool:
    """Return True if a source at rest moves in the state's frame, because the array moves."""
    x, _ = motion.start(np.arange(1.0, 1.0 + N_SOURCE), np.zeros((N_SOURCE, N_SOURCE)))
    return not np.allclose(motion.step(x, 1.0)[0], x, rtol=1e-9)


def _predict(mixture: Mixture, row: RowMeasurement, motion: MotionModel, dt_s: float) -> Mixture:
    """Return the mixture after a time without readings, in charts about the centroid of a row."""
    of_place, of_moment = displacement(motion, dt_s)
    strength = np.linalg.norm(mixture.x[:, 3:6], axis=1)
    S_q = np.zeros((len(mixture), N_SOURCE, N_SOURCE))
    at = np.arange(3)
    S_q[:, at, at] = of_place
    S_q[:, 3 + at, 3 + at] = of_moment * strength[:, None]
    after = replace(mixture, centroid_m=row.centroid_m)
    rows = np.concatenate([mixture.chart.jacobian(np.zeros_like(mixture.x)) @ mixture.S, S_q], axis=2)
    return replace(after, S=root_of(after.chart.inverse_jacobian() @ rows))
