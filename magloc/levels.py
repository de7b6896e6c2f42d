"""Probabilities and thresholds of all decisions, each with its reason.

Each test statistic has its own level here, even if two tests bear the same name.

Tests whose alarms cost little (a second search, one more solution) have a false-alarm rate of one in a thousand. Tests
that discard something for good (a track, the trust in a covariance) have one in a million: a record has thousands of
rows, and the noise of real sensors has heavier tails than the model.
"""

from __future__ import annotations

FALSE_ALARM = 1e-3
"""Share of rows without a source that are reported as having one. It holds for the energy of the differences, for the
matched filter, and, by simulation, for one more source in the same row."""

DELTA_CHI2_95 = 3.841458820694124
"""Rise of χ² at the ends of a 95 % interval of one parameter, with all others fitted again: the quantile of χ² with one
degree of freedom. Another optimum within this rise counts as a solution too."""

INTERVAL = 0.95
"""Confidence level of intervals and ellipses in plots and tables."""

SIGMAS_95 = 1.959963984540054
"""Standard deviations from the middle of a 95 % interval to its ends: the root of :data:`DELTA_CHI2_95`."""

CONSISTENCY = 0.99
"""Level of the two-sided bounds of NEES and NIS, for means and single rows. It is higher than :data:`INTERVAL` because
the bounds are checked often."""

TYPICAL_AND_BAD = (0.5, 0.95)
"""Quantiles of a bound over sources or moments: the median and the 95 % quantile."""

SECOND_LOOK = 1e-3
"""Probability of a fix's χ² under noise below which its residuals are searched for another cause. A search costs
little."""

MISFIT = 1e-6
"""Probability of a solution's χ² under noise below which the model does not hold and the covariance is invalid."""

CREDIBLE_ROW = 0.999
"""Quantile of χ² up to which a row counts as free of bad sensors. Rows above it are examined, which costs little."""

SENSOR_FALSE_ALARM = 1e-3
"""Share of rows in which a good sensor is excluded; it is divided among all sensors of the array."""

SUSPICIOUS_FIT = 0.99
"""Quantile of χ² of K sources above which another source is tried. A later test decides if it is kept."""

CREDIBLE_FIT = 0.9999
"""Quantile of χ² of K sources above which their search is repeated from random starts. It is higher than
:data:`CREDIBLE_ROW` because the repetition costs about twenty searches."""

CERTAIN_WEIGHT = 0.99
"""Posterior probability above which a solution counts as the only one."""

EXTENDED_BODY = 1e-3
"""Share of rows of a dipole that are reported as an extended body. It is divided among three tests: χ² and the decrease
of χ² by each of two multipoles."""

NO_OTHER_MISFIT = 0.05
"""Probability of the decrease of χ² by a multipole, relative to the remaining χ². Below it the body is extended; above
it the noise may be larger than stated."""

CONTRADICTION = 1e-6
"""Probability of a row's χ², given its track or the rows that start it, below which the row contradicts them. Three
contradictions end a track."""

DISAGREEMENT = 1e-3
"""Probability of the χ² of the offset between successive proposals for a start, below which they disagree. A later
start costs only a row."""

SIGMA_OF_MAD = 1.4826
"""Standard deviation of normal numbers, over the median of their absolute deviations."""
