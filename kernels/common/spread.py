"""How uncertain a sum of samples is: fed sample by sample, in the order of their strata where they have strata."""

import warp as wp


@wp.struct
class Spread:
    """What the variance of a sum needs of the terms seen so far."""

    paired: int  # 1: terms come one from each stratum, neighbours in turn
    count: int
    mean: float
    squares: float  # sum of squared deviations from the mean (Welford 1962)
    gaps: float  # sum over pairs of the squared difference
    last: float
    second_last: float
    third_last: float


@wp.func
def add_term(spread: Spread, term: float) -> Spread:
    """The spread with one more term."""
    result = spread
    result.count = spread.count + 1
    deviation = term - spread.mean
    result.mean = spread.mean + deviation / float(result.count)
    result.squares = spread.squares + deviation * (term - result.mean)
    if result.count % 2 == 0:
        result.gaps = spread.gaps + (term - spread.last) * (term - spread.last)
    result.third_last = spread.second_last
    result.second_last = spread.last
    result.last = term
    return result


@wp.func
def variance_of_sum(spread: Spread) -> float:
    """Variance of the sum of all terms; 0 if there are fewer than two.

    Strata: neighbours a, b are collapsed into one stratum and estimate its variance by (a - b)^2 (Cochran 1977,
    5A.12); what sets the strata apart only makes it larger, so it errs on the safe side. Of an odd number the last
    three are collapsed. Independent terms: count times their sample variance.
    """
    result = float(0.0)
    if spread.count > 1:
        if spread.paired == 1:
            result = spread.gaps
            if spread.count % 2 == 1:
                a = spread.third_last
                b = spread.second_last
                c = spread.last
                result += 0.5 * ((a - c) * (a - c) + (b - c) * (b - c) - (a - b) * (a - b))
        else:
            result = spread.squares * float(spread.count) / float(spread.count - 1)
    return result
