"""Test whether entries of x are far from all simulations that NPE was trained on."""

from torch import Tensor, nn

from sbi_rope._standardisation import FAR, deviations
from sbi_rope.diagnosis.report import Finding

__all__ = ["far_findings"]


def far_findings(embedding_net: nn.Module, x_o: Tensor) -> list[Finding]:
    """Return a finding about the entry of x that is farthest from simulations.

    Args:
        embedding_net: h with sbi's standardising layer. Without this layer there is no
            finding.
        x_o: The batch, shape ``(n_o, *event)``.
    """
    far = deviations(embedding_net, x_o)
    if far is None:
        return []
    far = far.flatten(1)
    row, column = divmod(int(far.argmax()), far.shape[1])
    value = float(far.max())
    return [
        Finding(
            name="entries far from simulations",
            value=value,
            threshold=FAR,
            alarming=value > FAR,
            concerns="stack and RoPE",
            sentence=(
                f"Entry {column} of observation {row} is {value:.2g} standard "
                "deviations of the simulations away from their mean, and none is "
                "farther."
            ),
            reason=(
                "Alarming above the threshold, which is far beyond any error of a "
                "simulator. Above it, the units may differ, or the entry may not vary "
                "in simulations, and the answer of NPE is arbitrary. Then leave the "
                "entry out, or train NPE with z_score_x='structured'."
            ),
        )
    ]
