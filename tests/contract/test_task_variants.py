"""The variants that every task has."""

from pathlib import Path

import pytest
import torch

from sbi_rope.errors import InvalidInputError
from sbi_rope.tasks import TASKS
from tests.tasks import at_most, make


@pytest.mark.parametrize("name", sorted(TASKS))
class TestCommonVariants:
    def test_shifted_parameters_stay_in_the_region(
        self, name: str, root: Path | None
    ) -> None:
        task = make(name, variant="prior_shift", root=root)
        n = at_most(100, name) // 3
        for theta, _ in (task.get_calibration_set(n), task.get_test_set(n)):
            for parameter, (low, high) in task.shifted_region.items():
                values = theta[:, task.parameter_names.index(parameter)]
                assert (values >= low).all()
                assert (values <= high).all()

    def test_biased_calibration_parameters_crowd_in_the_middle(
        self, name: str, root: Path | None
    ) -> None:
        task = make(name, variant="biased_calibration", root=root)
        n = at_most(200, name)
        calibration, test = (
            task.prior_quantiles(theta)[:, :3].std(dim=0)
            for theta, _ in (task.get_calibration_set(n), task.get_test_set(n))
        )
        # Standard deviations of Beta(3, 3) and of the uniform law, and a margin of
        # three standard errors or more.
        margin = 0.5 / n**0.5
        assert (calibration < 0.189 + margin).all()
        assert (test > 0.289 - margin).all()

    def test_noisy_labels_belong_to_the_observations_of_the_standard_task(
        self, name: str, root: Path | None
    ) -> None:
        clean, noisy = (
            make(name, variant=variant, root=root) for variant in (None, "noisy_labels")
        )
        n = at_most(200, name)
        theta, x = clean.get_calibration_set(n)
        noisy_theta, same_x = noisy.get_calibration_set(n)
        assert torch.equal(x, same_x)
        assert all(
            torch.equal(a, b)
            for a, b in zip(clean.get_test_set(50), noisy.get_test_set(50), strict=True)
        )
        scaled = (noisy_theta - theta) / clean.prior_std
        assert (scaled != 0).all()
        # Less than .2 where the prior's support cuts the noise.
        assert scaled.std(dim=0).max() < 0.2 * (1 + 2.2 / n**0.5)
        assert scaled.std(dim=0).min() > 0.2 * (0.85 - 2.2 / n**0.5)

    def test_label_noise_is_as_large_as_asked(
        self, name: str, root: Path | None
    ) -> None:
        small, large = (
            make(name, variant="noisy_labels", label_noise=noise, root=root)
            for noise in (0.001, 0.002)
        )
        n = at_most(200, name)
        truth, _ = make(name, root=root).get_calibration_set(n)
        ratio = [
            (task.get_calibration_set(n)[0] - truth).std(dim=0) / task.prior_std
            for task in (small, large)
        ]
        torch.testing.assert_close(
            ratio[0], torch.full_like(ratio[0], 0.001), rtol=2.8 / n**0.5, atol=0
        )
        torch.testing.assert_close(ratio[1], 2 * ratio[0], rtol=0.1, atol=0)

    @pytest.mark.parametrize("noise", [0.0, -0.1, 1.1, float("nan"), "0.1"])
    def test_bad_label_noise_is_refused(self, name: str, noise: object) -> None:
        with pytest.raises(InvalidInputError, match="label_noise"):
            make(name, variant="noisy_labels", label_noise=noise)

    def test_label_noise_without_its_variant_is_refused(self, name: str) -> None:
        with pytest.raises(InvalidInputError, match="noisy_labels"):
            make(name, label_noise=0.1)

    def test_well_specified_data_need_no_files(self, name: str) -> None:
        task = make(name, variant="well_specified")
        assert task.required_files == ()
        assert torch.isfinite(task.get_test_set(5)[1]).all()

    def test_unknown_variant_is_answered_with_those_there_are(self, name: str) -> None:
        with pytest.raises(InvalidInputError, match=r"prior_shift.*'nothing'"):
            make(name, variant="nothing")
