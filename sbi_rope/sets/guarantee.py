"""What a set with a guarantee promises."""

from dataclasses import dataclass

from sbi_rope.sets.conformal import promised_coverage

__all__ = ["Guarantee"]


@dataclass(frozen=True, kw_only=True)
class Guarantee:
    r"""The promise of a set or interval, for observations drawn as the pairs were.

    Let the calibration pairs and the new observation with its parameters be
    exchangeable, as pairs are that are drawn independently from one distribution. The
    set then holds the parameters with a probability of at least

    .. math:: 1 - 2 \alpha - \min\Big\{ \frac{2 (1 - 1/K)}{n/K + 1},
        \frac{1 - K/n}{K + 1} \Big\}, \qquad \alpha = 1 - \text{level},

    in theory, and of about the level in practice. Ninety per cent with 50 pairs in 5
    folds means at least 65.5 % in theory. The probability is an average over
    calibration sets and observations. It is not that at a given observation.

    The theorem holds for the candidates of a stack, which have not seen the labels of
    the fold that they are scored on. The weights of the stack, a few numbers, depend on
    these labels a little. In simulations with 10 to 50 pairs this changes the coverage
    by less than one per cent. Nothing is promised for observations drawn in another way
    than the pairs: :func:`sbi_rope.diagnose` compares a batch with them. A set ends
    where the support of the prior ends. The probability of parameters beyond it is in
    addition to that of a miss.

    References:
        | Predictive Inference with the Jackknife+ (Barber et al., 2021), theorem 4
        | https://arxiv.org/abs/1905.02928

    Attributes:
        level: The level that was asked for.
        num_pairs: The number n of calibration pairs with exact labels, one of each
            group.
        num_folds: The number K of folds.
    """

    level: float
    num_pairs: int
    num_folds: int

    @property
    def lower_bound(self) -> float:
        """The least probability in theory; 0 if theory promises nothing.

        Example:
            >>> round(Guarantee(level=0.9, num_pairs=50, num_folds=5).lower_bound, 3)
            0.655
        """
        return promised_coverage(self.level, self.num_pairs, self.num_folds)

    def says(self, what: str) -> str:
        """Return the promise in words.

        Args:
            what: What holds what, such as "it holds the true parameters".
        """
        return (
            f"For observations drawn as the {self.num_pairs} calibration pairs were, "
            f"{what} in about {self.level:.4g} of the cases, and in at least "
            f"{self.lower_bound:.3f} of them in theory, on average over observations "
            "and calibration sets."
        )

    def __str__(self) -> str:
        return self.says("it holds the true parameters")

    __repr__ = __str__  # which notebooks show
