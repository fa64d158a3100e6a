r"""Networks trained and evaluated at once: the parameters of E members in one network.

A step of a small network is mostly overhead, which E members share if their batches
are rows of one batch: those of member e are the rows ``e * B`` to ``(e + 1) * B``. Only
modules that hold parameters need to know whose rows they see. These are replaced.
"""

import copy
from collections.abc import Callable, Sequence
from typing import Any

import nflows.nn.nde.made
import nflows.transforms.made
import torch
import torch.nn.functional as F
import zuko.nn
from nflows.transforms.lu import LULinear
from torch import Tensor, nn

from sbi_rope.utils.errors import SamplingError
from sbi_rope.utils.seeds import seeded

# What is asked of a network: its answers to rows. The first argument is the network.
Question = Callable[..., Tensor]


def embedded(net: Any, x: Tensor) -> Tensor:
    """Return embeddings, ``(n, *event)`` to ``(n, l)``; a net may work in place."""
    return net(x.clone())


def log_density(density: Any, theta: Tensor, z: Tensor) -> Tensor:
    """Return the log densities of pairs, ``(n, d)`` and ``(n, l)`` to ``(n,)``."""
    return density.log_prob(theta[None], z)[0]


def loss_of(density: Any, theta: Tensor, z: Tensor) -> Tensor:
    """Return the losses of pairs, ``(n, d)`` and ``(n, l)`` to ``(n,)``."""
    return density.loss(theta, condition=z)


def drawn(density: Any, z: Tensor) -> Tensor:
    """Draw once given each condition, ``(n, l)`` to ``(n, d)``."""
    try:
        return density.sample(torch.Size((1,)), z)[0]
    except ValueError as error:  # of sbi's mixtures of Gaussians
        raise SamplingError(
            "Expected a density that can be sampled given all observations; got "
            f"{error}. Leave out observations that are far from all simulations."
        ) from error


class _Stacked(nn.Module):
    """A module that holds the parameters of E members, each ``(E, ...)``."""

    def __init__(self, members: Sequence[nn.Module]) -> None:
        super().__init__()
        self.names = [name for name, _ in members[0].named_parameters()]
        each = [[one.detach() for one in member.parameters()] for member in members]
        self.stacks = nn.ParameterList(map(torch.stack, zip(*each, strict=True)))
        # The rest of a member: buffers, settings and parts without parameters.
        self.rest = copy.deepcopy(members[0])
        for name in self.names:
            path, _, leaf = name.rpartition(".")
            self.rest.get_submodule(path)._parameters[leaf] = None

    def member(self, parameters: Sequence[Tensor]) -> nn.Module:
        """Return a member with these parameters, which shares all else with others."""
        clone = _shallow(self.rest)
        for name, value in zip(self.names, parameters, strict=True):
            path, _, leaf = name.rpartition(".")
            owner: Any = clone.get_submodule(path)
            owner._parameters[leaf] = value
        for part in clone.modules():
            if isinstance(part, nn.RNNBase):  # has a list of its parameters, too
                part._init_flat_weights()
        return clone


def _shallow(module: nn.Module) -> nn.Module:
    """Copy a module without its tensors."""
    clone = copy.copy(module)
    clone._parameters = dict(module._parameters)
    clone._modules = {
        name: None if child is None else _shallow(child)
        for name, child in module._modules.items()
    }
    return clone


class _Linear(_Stacked):
    """Linear layers, with or without a mask."""

    def forward(self, x: Tensor) -> Tensor:
        weight, *bias = self.stacks
        mask = getattr(self.rest, "mask", None)
        if mask is not None:
            weight = weight * mask
        rows = x.reshape(len(weight), -1, x.shape[-1])
        args = rows, weight.mT
        y = torch.baddbmm(bias[0][:, None], *args) if bias else torch.bmm(*args)
        return y.reshape(*x.shape[:-1], weight.shape[1])


class _LULinear(_Stacked):
    """Linear maps of nflows by their LU decomposition."""

    def forward(self, x: Tensor, context: Any = None) -> tuple[Tensor, Tensor]:
        lower, upper, log_det, bias = self._matrices()
        rows = x.reshape(len(bias), -1, x.shape[-1])
        y = rows @ upper.mT @ lower.mT + bias[:, None]
        return y.reshape(x.shape), log_det.repeat_interleave(rows.shape[1])

    def inverse(self, x: Tensor, context: Any = None) -> tuple[Tensor, Tensor]:
        lower, upper, log_det, bias = self._matrices()
        rows = x.reshape(len(bias), -1, x.shape[-1]) - bias[:, None]
        solve = torch.linalg.solve_triangular
        y = solve(lower, rows.mT, upper=False, unitriangular=True)
        y = solve(upper, y, upper=True).mT
        return y.reshape(x.shape), -log_det.repeat_interleave(rows.shape[1])

    def _matrices(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        one: Any = self.rest
        values = dict(zip(self.names, self.stacks, strict=True))
        diagonal = F.softplus(values["unconstrained_upper_diag"]) + one.eps
        lower = torch.diag_embed(torch.ones_like(diagonal))
        lower[:, one.lower_indices[0], one.lower_indices[1]] = values["lower_entries"]
        upper = torch.diag_embed(diagonal)
        upper[:, one.upper_indices[0], one.upper_indices[1]] = values["upper_entries"]
        return lower, upper, diagonal.log().sum(dim=1), values["bias"]


class _Loop(_Stacked):
    """Any other module with parameters: each member sees its own rows."""

    def forward(self, *rows: Any, **options: Any) -> Any:
        return self.answer(nn.Module.__call__, *rows, **options)

    def answer(self, question: Question, *rows: Any, **options: Any) -> Any:
        count, E = len(rows[0]), len(self.stacks[0])

        def parts(value: Any) -> Sequence[Any]:
            is_rows = isinstance(value, Tensor) and value.ndim and len(value) == count
            return value.chunk(E) if is_rows else [value] * E

        answers = [
            question(self.member(parameters), *of_member, **options)
            for parameters, *of_member in zip(
                zip(*self.stacks, strict=True), *map(parts, rows), strict=True
            )
        ]
        if E == 1:
            return answers[0]
        if isinstance(answers[0], Tensor):
            return torch.cat(answers)
        return type(answers[0])(map(torch.cat, zip(*answers, strict=True)))


STACKED: dict[type[nn.Module], type[_Stacked]] = {
    nn.Linear: _Linear,
    nflows.transforms.made.MaskedLinear: _Linear,
    nflows.nn.nde.made.MaskedLinear: _Linear,
    zuko.nn.MaskedLinear: _Linear,
    zuko.nn.Linear: _Linear,
    LULinear: _LULinear,
}


class Ensemble(nn.Module):
    """Copies of networks that differ in parameters only, in evaluation mode.

    Args:
        members: The networks. The same one may appear several times.
        question: What the network will be asked, such as :func:`log_density`.
        example: Rows to ask it. A network that mixes up the rows of members, such as
            one that puts another dimension first, is looped over as a whole.
    """

    def __init__(
        self, members: Sequence[nn.Module], question: Question, example: Sequence[Any]
    ) -> None:
        super().__init__()
        self.num_members = len(members)
        self.net = _stacked(members)
        is_one = len(members) == 1 or not list(self.parameters())
        if not is_one and not _keeps_rows(members[0], question, example):
            self.net = _Loop(members)
        self.eval()

    def __len__(self) -> int:
        return self.num_members

    def answer(self, question: Question, *rows: Tensor) -> Tensor:
        """Ask all members, each about its own rows: ``(E * B, ...)`` in and out."""
        if isinstance(self.net, _Loop):
            return self.net.answer(question, *rows)
        return question(self.net, *rows)

    def __getitem__(self, numbers: Tensor | Sequence[int]) -> "Ensemble":
        """Return an ensemble of copies of some members."""
        numbers = torch.arange(len(self))[torch.as_tensor(numbers)]
        return self._of([one[numbers] for one in self.parameters()], len(numbers))

    @classmethod
    def joined(cls, ensembles: Sequence["Ensemble"]) -> "Ensemble":
        """Return an ensemble of the members of several, of one architecture."""
        stacks = zip(*(one.parameters() for one in ensembles), strict=True)
        return ensembles[0]._of(list(map(torch.cat, stacks)), sum(map(len, ensembles)))

    def _of(self, stacks: Sequence[Tensor], count: int) -> "Ensemble":
        """Return a copy with other parameters, those of so many members."""
        one = copy.deepcopy(self)
        one.num_members = count
        for parameter, stack in zip(one.parameters(), stacks, strict=True):
            parameter.data, parameter.grad = stack.detach(), None
        return one

    def then(self, layer: nn.Module) -> "Ensemble":
        """Return copies of all members, followed by a layer without parameters."""
        one = copy.deepcopy(self)
        one.net = nn.Sequential(one.net, layer)
        return one

    def member(self, number: int) -> Any:
        """Return a copy of one member, a network of its own."""

        def unstacked(module: nn.Module) -> nn.Module:
            if isinstance(module, _Stacked):
                own = (nn.Parameter(s[number], s.requires_grad) for s in module.stacks)
                return module.member(list(own))
            for name, child in module._modules.items():
                if child is not None:
                    module._modules[name] = unstacked(child)
            return module

        return copy.deepcopy(unstacked(copy.deepcopy(self.net))).eval()


def _stacked(members: Sequence[nn.Module]) -> Any:
    """Return a copy of the first member with the parameters of all."""
    done: dict[int, _Stacked] = {}

    def replaced(module: Any, others: Sequence[Any]) -> nn.Module:
        if id(others[0]) in done:
            return done[id(others[0])]
        if own := list(module.parameters(recurse=False)):
            kind = STACKED.get(type(module), _Loop)
            # zuko has stacks of linear layers, too.
            done[id(others[0])] = (_Loop if own[0].ndim > 2 else kind)(others)
            return done[id(others[0])]
        for name, child in module._modules.items():
            if child is not None:
                of_each = [other._modules[name] for other in others]
                module._modules[name] = replaced(child, of_each)
        return module

    return replaced(copy.deepcopy(members[0]), members)


@torch.no_grad()
def _keeps_rows(
    member: nn.Module, question: Question, example: Sequence[Tensor]
) -> bool:
    """Tell whether two members answer in one network as each does alone."""
    first, other = copy.deepcopy(member).eval(), copy.deepcopy(member).eval()
    with seeded(0):
        for parameter in other.parameters():
            scale = parameter.abs().mean() + 0.01
            parameter.add_(0.1 * scale * torch.randn_like(parameter))
    alone = torch.cat([question(net, *example) for net in (first, other)])
    rows = [torch.cat([part, part]) for part in example]
    try:
        found = question(_stacked([first, other]).eval(), *rows)
        return torch.allclose(found, alone, rtol=1e-3, atol=1e-3)
    except (RuntimeError, ValueError, TypeError, AttributeError):
        return False
