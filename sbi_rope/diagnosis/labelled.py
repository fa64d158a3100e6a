"""Say whether a batch is like the observations of the calibration pairs."""

from sbi_rope._two_sample import LEVEL, TwoSampleTest
from sbi_rope.diagnosis.report import UNLIKE_PAIRS, Finding

__all__ = ["UNLIKE_PAIRS", "labelled_finding"]


def labelled_finding(test: TwoSampleTest) -> Finding:
    """Return the finding of a test whose first set are the pairs."""
    size = (
        f"its observations are {test.spread:.2f} times as far apart as those of the "
        "pairs"
    )
    if test.is_different:
        sentence = (
            f"As NPE sees it, the batch differs from the calibration pairs: {size}. "
            "The weights of a stack, its scores and its calibration were found on the "
            "pairs, and need not hold for this batch. The same is true of what sets "
            "with a guarantee promise. Label some observations like those of the batch."
        )
    else:
        sentence = (
            "No sign that the batch differs from the calibration pairs, as NPE sees "
            f"them: {size}."
        )
    return Finding(
        name=UNLIKE_PAIRS,
        value=test.p_value,
        threshold=LEVEL,
        alarming=test.is_different,
        is_p_value=True,
        concerns="stack and RoPE",
        sentence=sentence,
        reason=(
            "Alarming below the threshold (the p-value of an energy test): one batch "
            "in a hundred that is drawn like the pairs falls there."
        ),
    )
