"""Every probability that decides something, and every threshold that follows from one, each with its reason.

A word has one value for one statistic; where a word is asked of different statistics, each has its own value here.

Of a test whose alarms cost little (a second look, another solution that is kept) one in a thousand is enough. Of one
that throws something away for good (a track, the trust in a covariance) one in a million is taken: a record has
thousands of rows, and the noise of real sensors has heavier tails than the model's.
"""

from __future__ import annotations

FALSE_ALARM = 1e-3
"""Rows without a source that are taken for rows with one: energy of the differences, matched filter, and one more
source in the same row (there by simulation). One row in a thousand is looked at in vain."""

DELTA_CHI2_95 = 3.841458820694124
"""Rise of χ² up to the ends of a 95 % interval of one parameter, all others fitted anew: quantile of χ² with 1 degree
of freedom; another optimum within it is a solution too."""

INTERVAL = 0.95
"""Intervals and ellipses that are drawn and printed."""

SIGMAS_95 = 1.959963984540054
"""Standard deviations from the middle of a 95 % interval to its ends: the root of :data:`DELTA_CHI2_95`."""

CONSISTENCY = 0.99
"""Two-sided bounds of NEES and NIS, of means and of single rows: wider than an interval, for they are looked at
often."""

TYPICAL_AND_BAD = (0.5, 0.95)
"""Quantiles of a bound over sources or moments: the median, and what all but one in twenty stay below."""

SECOND_LOOK = 1e-3
"""χ² of a fix under noise below which what is left of its row is searched for another cause: a look costs little."""

MISFIT = 1e-6
"""χ² of a solution under noise below which the model does not hold: its covariance is then not believed."""

CREDIBLE_ROW = 0.999
"""Quantile of χ² up to which a row is believed to have no bad sensor: those above it are examined, which costs
little."""

SENSOR_FALSE_ALARM = 1e-3
"""Rows of which a good sensor is left out, shared among all sensors of the array."""

SUSPICIOUS_FIT = 0.99
"""Quantile of χ² of K sources above which another source is tried: whether it pays is tested afterwards."""

CREDIBLE_FIT = 0.9999
"""Quantile of χ² of K sources above which their search is repeated from random starts: the price is some twenty
searches, so that it lies farther out than :data:`CREDIBLE_ROW`."""

CERTAIN_WEIGHT = 0.99
"""Posterior probability from which on a solution is as good as the only one."""

EXTENDED_BODY = 1e-3
"""Rows of a dipole that are said to be of an extended body, shared among χ² and the gains by two multipoles."""

NO_OTHER_MISFIT = 0.05
"""Gain by a multipole, against what no multipole explains, below which it is the body that is extended and not the
noise that is understated."""

CONTRADICTION = 1e-6
"""χ² of a row, given the track or the rows that start it, below which it contradicts them: three of them end a
track."""

DISAGREEMENT = 1e-3
"""χ² of the offset between successive proposals for a start below which they disagree: a later start costs a row."""
