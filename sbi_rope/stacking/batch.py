"""Whether a batch is like the observations that its stack was scored on."""

from torch import Tensor

from sbi_rope._sbi import embed
from sbi_rope._two_sample import TwoSampleTest, compare_with_pairs
from sbi_rope.errors import warn_user
from sbi_rope.stacking.workbench import Workbench

__all__ = ["compare_batch"]


def compare_batch(bench: Workbench, x_o: Tensor) -> TwoSampleTest | None:
    """Compare a batch with the calibration pairs, and warn if they clearly differ.

    Args:
        bench: What all candidates share.
        x_o: The batch, shape ``(n_o, *event)``.

    Returns:
        An energy test of the embeddings h(x), with the pairs as the first set, or None
        if there are too few observations or pairs.
    """
    net = bench.embedding_net
    test = compare_with_pairs(embed(net, bench.x), bench.groups, embed(net, x_o))
    if test is not None and test.is_different:
        warn_user(
            f"The batch `x_o` differs from the observations of the calibration pairs "
            f"(p = {test.p_value:.3f}; its observations are {test.spread:.2f} times as "
            "far apart). The weights, the scores and the calibration of the stack hold "
            "for observations like those of the pairs, and need not hold for this "
            "batch. Look at `diagnose(rope, x_o)`, and label some observations like "
            "those of the batch."
        )
    return test
