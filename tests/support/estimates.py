"""Statistical claims about estimates, checked at one significance; used by several test files."""

import numpy as np
from scipy import stats

SIGNIFICANCE = 1e-4
"""Probability of a false alarm of each check; seeds are fixed, so a failure is a change of code, not bad luck."""

LARGEST_Z = stats.norm.isf(SIGNIFICANCE / 2)


def require_density(counts, mass, least=20.0):
    """Draws fall into cells as often as their mass says; cells that expect fewer than ``least`` count as one."""
    counts, expected = np.ravel(counts), np.ravel(mass) * np.sum(counts)
    large = expected > least
    observed = np.append(counts[large], counts[~large].sum())
    wanted = np.append(expected[large], expected[~large].sum())
    assert stats.chisquare(observed, wanted * observed.sum() / wanted.sum()).pvalue > SIGNIFICANCE


def by_point(values):
    """Mean over all axes but the first: channels of a point see the same rays and count once."""
    return np.asarray(values, dtype=np.float64).reshape(len(values), -1).mean(axis=1)


def require_zero_mean(errors, allowance=0.0):
    """Errors of independent points have mean 0, within an allowance for known bias."""
    errors = by_point(errors)
    noise = LARGEST_Z * errors.std(ddof=1) / np.sqrt(len(errors))
    assert abs(errors.mean()) <= noise + allowance, f"mean error {errors.mean():.3g}, noise {noise:.3g}"


def require_honest(errors, stated, *, independent, allowance=0.0):
    """Squared errors average to the squared stated errors for independent samples; for strata to less, not a 25th.

    Squares, not quotients: a variance estimate is unbiased, while one that missed rare events makes a large quotient.
    """
    squares, variances = by_point(errors**2), by_point(np.asarray(stated, np.float64) ** 2)
    excess = squares - variances
    noise = LARGEST_Z * excess.std(ddof=1) / np.sqrt(len(excess)) + allowance * variances.mean()
    found = f"errors of {np.sqrt(squares.mean()):.4g} RMS are stated as {np.sqrt(variances.mean()):.4g}"
    assert excess.mean() <= noise, found
    assert excess.mean() >= -noise if independent else squares.mean() > variances.mean() / 25.0, found
