r"""Task D: stroke volume and ejection time, from the pulse at the wrist."""

from dataclasses import dataclass
from pathlib import Path

import torch
from torch import Tensor, nn

from sbi_rope.npe.prior import check_in_support
from sbi_rope.tasks.base import Task
from sbi_rope.tasks.hemodynamics.dataset import BeatSet, load
from sbi_rope.tasks.hemodynamics.population import Process
from sbi_rope.tasks.hemodynamics.prior import PopulationPrior
from sbi_rope.tasks.hemodynamics.records import NUM_STEPS, Normalisation, Recorder
from sbi_rope.tasks.networks import SeriesEmbedding, light_series_embedding
from sbi_rope.tasks.settings import PaperSettings
from sbi_rope.tasks.splits import DrawnPairs, Part, RecordedPairs, generator_of
from sbi_rope.utils.errors import InvalidInputError
from sbi_rope.utils.tensors import as_batch

SHIPPED = Path(__file__).parent / "data"
CHUNK_SIZE = 1000  # parameters that are looked up together


@dataclass(frozen=True, kw_only=True, eq=False)
class NearestBeatSimulator:
    r"""Recordings of the simulated person whose parameters are nearest.

    Solving the equations of blood flow takes a third of a second, so that a simulator
    that is called many times looks people up instead:

    .. math:: S(\theta) = \mathrm{record}\left(p_j\right), \qquad
        j = \arg\min_j \left\| (\theta - \theta_j) / \mathrm{sd} \right\|,

    where starts and noise of the recordings are drawn anew in every call. At the
    parameters of a stored person it is that person's exact simulation; in between,
    its error is the distance to the nearest one.

    Args:
        theta: Stroke volumes and ejection times of the stored people, shape
            ``(m, 2)``.
        beat: Their beats in mmHg, shape ``(m, 256)``.
        period: Lengths of the beats in s, shape ``(m,)``.
        theta_std: The prior's standard deviations, shape ``(2,)``.
        recorder: How a beat is recorded.
    """

    theta: Tensor
    beat: Tensor
    period: Tensor
    theta_std: Tensor
    recorder: Recorder

    def __call__(self, theta: Tensor) -> Tensor:
        """Simulate ``theta`` of shape ``(n, 2)``, to shape ``(n, 1000)``."""
        theta = as_batch("theta", theta, (2,), empty=True)
        device = theta.device
        scale = self.theta_std.to(device)
        stored = self.theta.to(device) / scale
        chunks = (theta.float() / scale).split(CHUNK_SIZE)
        # Plain differences: a matrix product would not find an exact match at 0.
        nearest = torch.cat(
            [
                torch.cdist(
                    chunk, stored, compute_mode="donot_use_mm_for_euclid_dist"
                ).argmin(dim=1)
                for chunk in chunks
            ]
        )
        beat, period = self.beat.to(device)[nearest], self.period.to(device)[nearest]
        return self.recorder(beat.to(theta.dtype), period.to(theta.dtype))


class Hemodynamics(Task):
    r"""Task D of the paper: the heart, from eight seconds of pressure at the wrist.

    The parameters are the stroke volume, the net volume that leaves the heart in a
    beat, and the left ventricular ejection time. An observation is the normalised
    pressure in the left radial artery, 1000 samples at 125 Hz from a random moment on,
    with white noise. Heart rate, blood pressure, stiffness and size of the arteries
    and more are nuisances of a healthy population (``Population``), whose law of
    the two parameters is the prior (``PopulationPrior``). Blood flow in 116 arteries is
    simulated by ``simulate_beat``.

    In the simulator, all people have arteries of the same lengths. In the real process
    lengths follow the height of a person, and scatter from segment to segment.

    Both are stored beats: a small set of each comes with the package, larger ones are
    made by ``python -m sbi_rope.tasks.hemodynamics generate``. Simulations are
    recordings of stored simulated people (:class:`NearestBeatSimulator`), as many as
    asked for; each stored real person is recorded once. A fixed third of the real
    people is for calibration, the rest for tests. In the variant ``"well_specified"``,
    half of the simulated people are the real ones, and the other half is left to
    simulate.

    The solver, its validation and the data sets are described in
    ``docs/background/hemodynamics.md``.

    Args:
        variant, root, label_noise: See :class:`~sbi_rope.tasks.Task`.
        simulations: File of simulated people. It is the small one of the package
            unless given.
        observations: File of real people. It is the small one of the package unless
            given.
        noise_std: Standard deviation of the noise, after normalisation.
        normalisation: ``"per_record"``, to mean 0 and standard deviation 1, or
            ``"global"``, which keeps the level and the height of the pulse.

    Example:
        >>> theta, x_o = Hemodynamics().get_calibration_set(50)
        >>> theta.shape, x_o.shape
        (torch.Size([50, 2]), torch.Size([50, 1000]))
    """

    name = "hemodynamics"
    parameter_names = ("stroke_volume", "ejection_time")
    parameter_units = ("ml", "ms")
    x_shape = (NUM_STEPS,)
    z_score_x = "none"
    misspecification = (
        "all people have arteries of the same lengths, whatever their height"
    )
    shifted_region = {"stroke_volume": (60.0, 200.0), "ejection_time": (282.0, 600.0)}  # noqa: RUF012
    paper_settings = PaperSettings(
        density_estimator="maf",
        conditioner=(300, 300, 300, 300),
        integrand=(),
        num_validation=2000,
        finetuning_learning_rate=1e-5,
        finetuning_steps=2000,
        joint_epoch_size=6000,
    )

    def __init__(
        self,
        *,
        variant: str | None = None,
        root: str | Path | None = None,
        label_noise: float | None = None,
        simulations: str | Path | None = None,
        observations: str | Path | None = None,
        noise_std: float = 0.05,
        normalisation: Normalisation = "per_record",
    ) -> None:
        super().__init__(variant=variant, root=root, label_noise=label_noise)
        self.simulations = simulations
        self.observations = observations
        self.recorder = Recorder(noise_std=noise_std, normalisation=normalisation)

    def get_prior(self) -> PopulationPrior:
        """Return the law of both parameters in the population."""
        return PopulationPrior()

    def prior_quantiles(self, theta: Tensor) -> Tensor:
        """Return the distribution functions of both parameters, ``(n, 2)``."""
        return self.get_prior().marginal_cdf(theta)

    def get_simulator(self) -> NearestBeatSimulator:
        """Return the simulator that looks simulated people up."""
        people = self._load(self.simulations, "simulator")
        step = 2 if self.variant == "well_specified" else 1
        return NearestBeatSimulator(
            theta=people.theta[::step],
            beat=people.beat[::step],
            period=people.period[::step],
            theta_std=self.prior_std,
            recorder=self.recorder,
        )

    def get_embedding_net(self, *, light: bool = False) -> nn.Module:
        """Return the paper's convolutional network or a light one, of five outputs."""
        if light:
            return light_series_embedding(num_steps=NUM_STEPS, output_dim=5)
        pools = ((4, 2), (4, 2), (4, 1))
        return SeriesEmbedding(
            num_steps=NUM_STEPS, output_dim=5, pools=pools, decimation=2
        )

    def _simulated_process(self) -> DrawnPairs:
        simulator = self.get_simulator()
        return DrawnPairs(draw_theta=_Rounds(simulator.theta), observe=simulator)

    def _real_process(self, part: Part) -> RecordedPairs:
        people = self._load(self.observations, "real")
        simulated = self._load(self.simulations, "simulator")
        if people.settings["physics"] != simulated.settings["physics"]:
            raise InvalidInputError(
                "Expected `observations` made with the physics of `simulations`; got "
                f"{people.settings['physics']} and {simulated.settings['physics']}."
            )
        return self._recorded(people)

    def _well_specified_process(self, part: Part) -> RecordedPairs:
        people = self._load(self.simulations, "simulator")
        return self._recorded(people, first=1, step=2)

    def _recorded(
        self, people: BeatSet, *, first: int = 0, step: int = 1
    ) -> RecordedPairs:
        chosen = slice(first, None, step)
        beat, period = people.beat[chosen], people.period[chosen]
        cohort = f"{people.settings['process']} {people.settings['seed']}"
        index = people.index[chosen].tolist()

        def read_x(rows: list[int]) -> Tensor:
            records = [
                self.recorder(
                    beat[row : row + 1],
                    period[row : row + 1],
                    # Each person is recorded once, whenever that is.
                    generator=generator_of(f"recording {cohort} {index[row]}"),
                )
                for row in rows
            ]
            return torch.cat(records)

        return RecordedPairs(theta=people.theta[chosen], read_x=read_x)

    def _load(self, path: str | Path | None, process: Process) -> BeatSet:
        if path is None:
            path = SHIPPED / f"{process}.npz"
        people = load(path, process=process)
        check_in_support(f"theta of {path}", people.theta, self.get_prior())
        return people


class _Rounds:
    """Draws all stored parameters in a random order, and then again in another."""

    def __init__(self, theta: Tensor) -> None:
        self.theta = theta
        self.left = theta[:0]

    def __call__(self, n: int) -> Tensor:
        while len(self.left) < n:
            order = torch.randperm(len(self.theta))
            self.left = torch.cat([self.left, self.theta[order]])
        drawn, self.left = self.left[:n], self.left[n:]
        return drawn
