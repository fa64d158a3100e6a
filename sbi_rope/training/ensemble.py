r"""Networks trained and evaluated at once: the parameters of E members in one network.

A step of a small network is not arithmetic but overhead, which E members share if their
batches are rows of one batch: those of member e are the rows ``e * B`` to
``(e + 1) * B``. An estimator treats rows independently, so that only the modules that
hold parameters need to know whose rows they see. These are replaced; everything else
runs unchanged.
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
        self.num_members = len(members)
        # In a list, so that its own parameters are not trained.
        self._one = [copy.deepcopy(members[0]).requires_grad_(requires_grad=False)]
        self.names = [name for name, _ in members[0].named_parameters()]
        each = [dict(member.named_parameters()) for member in members]
        self.stacks = nn.ParameterList(
            torch.stack([of_one[name].detach() for of_one in each])
            for name in self.names
        )

    def member(self, number: int) -> nn.Module:
        """Return the module of one member."""
        one = copy.deepcopy(self._one[0])
        with torch.no_grad():
            for name, stack in zip(self.names, self.stacks, strict=True):
                one.get_parameter(name).copy_(stack[number])
        return one

    def train(self, mode: bool = True) -> Any:  # noqa: FBT001, FBT002
        """Switch dropout and batch statistics of the members on or off."""
        self._one[0].train(mode)
        return super().train(mode)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:  # noqa: FBT001, FBT002
        self._one[0]._apply(fn)
        return super()._apply(fn, recurse)


class _Linear(_Stacked):
    """Linear layers, with or without a mask."""

    def forward(self, x: Tensor) -> Tensor:
        weight, *bias = self.stacks
        mask = getattr(self._one[0], "mask", None)
        if mask is not None:
            weight = weight * mask
        rows = x.reshape(self.num_members, -1, x.shape[-1])
        if bias:
            y = torch.baddbmm(bias[0][:, None], rows, weight.mT)
        else:
            y = rows @ weight.mT
        return y.reshape(*x.shape[:-1], weight.shape[1])


class _LULinear(_Stacked):
    """Linear maps of nflows by their LU decomposition."""

    def forward(self, x: Tensor, context: Any = None) -> tuple[Tensor, Tensor]:
        lower, upper, log_det, bias = self._matrices()
        rows = x.reshape(self.num_members, -1, x.shape[-1])
        y = rows @ upper.mT @ lower.mT + bias[:, None]
        return y.reshape(x.shape), log_det.repeat_interleave(rows.shape[1])

    def inverse(self, x: Tensor, context: Any = None) -> tuple[Tensor, Tensor]:
        lower, upper, log_det, bias = self._matrices()
        rows = x.reshape(self.num_members, -1, x.shape[-1]) - bias[:, None]
        solve = torch.linalg.solve_triangular
        y = solve(lower, rows.mT, upper=False, unitriangular=True)
        y = solve(upper, y, upper=True).mT
        return y.reshape(x.shape), -log_det.repeat_interleave(rows.shape[1])

    def _matrices(self) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        one: Any = self._one[0]
        values = dict(zip(self.names, self.stacks, strict=True))
        diagonal = F.softplus(values["unconstrained_upper_diag"]) + one.eps
        lower = torch.diag_embed(torch.ones_like(diagonal))
        lower[:, one.lower_indices[0], one.lower_indices[1]] = values["lower_entries"]
        upper = torch.diag_embed(diagonal)
        upper[:, one.upper_indices[0], one.upper_indices[1]] = values["upper_entries"]
        return lower, upper, diagonal.log().sum(dim=1), values["bias"]


class _Loop(_Stacked):
    """Any other module with parameters: each member's copy sees its own rows."""

    # One module for each member, whose parameters are views of the stacks, also when
    # gradients are computed: some layers evaluate their network once more then.
    _each: Sequence[nn.Module] = ()

    def forward(self, *rows: Any, **options: Any) -> Any:
        return self.answer(nn.Module.__call__, *rows, **options)

    def answer(self, question: Question, *rows: Any, **options: Any) -> Any:
        count, E = len(rows[0]), self.num_members

        def parts(value: Any) -> Sequence[Any]:
            is_rows = isinstance(value, Tensor) and value.ndim and len(value) == count
            return value.chunk(E) if is_rows else [value] * E

        answers = [
            question(module, *args, **options)
            for module, *args in zip(
                self._modules_of_each(), *map(parts, rows), strict=True
            )
        ]
        if E == 1:
            return answers[0]
        if isinstance(answers[0], Tensor):
            return torch.cat(answers)
        return type(answers[0])(map(torch.cat, zip(*answers, strict=True)))

    def _modules_of_each(self) -> Sequence[nn.Module]:
        if len(self._each) < self.num_members:
            self._each = [copy.deepcopy(self._one[0]) for _ in range(self.num_members)]
        self._each = self._each[: self.num_members]
        for name, stack in zip(self.names, self.stacks, strict=True):
            path, _, leaf = name.rpartition(".")
            for module, value in zip(self._each, stack.unbind(), strict=True):
                owner: Any = module.get_submodule(path)
                owner._parameters[leaf] = value
        return self._each

    def train(self, mode: bool = True) -> Any:  # noqa: FBT001, FBT002
        """Switch dropout and batch statistics of the members on or off."""
        for module in self._each:
            module.train(mode)
        return super().train(mode)

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> Any:  # noqa: FBT001, FBT002
        self._each = ()
        return super()._apply(fn, recurse)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "_each": ()}


STACKED: dict[type[nn.Module], type[_Stacked]] = {
    nn.Linear: _Linear,
    nflows.transforms.made.MaskedLinear: _Linear,
    nflows.nn.nde.made.MaskedLinear: _Linear,
    zuko.nn.MaskedLinear: _Linear,
    zuko.nn.Linear: _Linear,
    LULinear: _LULinear,
}


class Ensemble(nn.Module):
    """E networks of one architecture, in evaluation mode.

    Args:
        members: The networks; they are copied. The same one may appear several times.
        question: What the network will be asked, such as :func:`log_density`.
        example: Rows to ask it. A network that mixes up the rows of members, such as
            one that puts another dimension first, is looped over as a whole.
    """

    def __init__(
        self,
        members: Sequence[nn.Module],
        question: Question,
        example: Sequence[Tensor],
    ) -> None:
        super().__init__()
        first, *others = (list(member.buffers()) for member in members)
        for buffers in others:  # such as means and deviations by which x is divided
            if not all(map(torch.equal, first, buffers)):
                raise ValueError("Expected members that differ in parameters only.")
        self.num_members = len(members)
        self.net = _stacked(members)
        if len(members) > 1 and not _keeps_rows(members[0], question, example):
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
        some = copy.deepcopy(self)
        numbers = torch.arange(len(self))[torch.as_tensor(numbers)]
        some.num_members = len(numbers)
        for layer in some.layers():
            layer.num_members = len(numbers)
            for stack in layer.stacks:
                stack.data = stack.data[numbers]
                stack.grad = None
        return some

    @classmethod
    def joined(cls, ensembles: Sequence["Ensemble"]) -> "Ensemble":
        """Return an ensemble of the members of several, of one architecture."""
        one = copy.deepcopy(ensembles[0])
        one.num_members = sum(map(len, ensembles))
        for layers in zip(one.layers(), *(e.layers() for e in ensembles), strict=True):
            first, *each = layers
            first.num_members = one.num_members
            for number, stack in enumerate(first.stacks):
                stack.data = torch.cat([layer.stacks[number].data for layer in each])
        return one

    def then(self, layer: nn.Module) -> "Ensemble":
        """Return copies of all members, followed by a layer without parameters."""
        one = copy.deepcopy(self)
        one.net = nn.Sequential(one.net, layer)
        return one

    def member(self, number: int) -> Any:
        """Return a copy of one member, a network of its own."""
        net = copy.deepcopy(self.net)
        if isinstance(net, _Stacked):
            return net.member(number).eval()
        for module in list(net.modules()):
            for name, child in module._modules.items():
                if isinstance(child, _Stacked):
                    module._modules[name] = child.member(number)
        return net.eval()

    def layers(self) -> list[_Stacked]:
        """Return the modules that hold the parameters, in the order of the network."""
        return [part for part in self.net.modules() if isinstance(part, _Stacked)]


def resize(network: nn.Module, old: int, new: int) -> None:
    """Tell the ensembles in a network that their stacks hold another number now."""
    for part in network.modules():
        if isinstance(part, Ensemble | _Stacked) and part.num_members == old:
            part.num_members = new


def _stacked(members: Sequence[nn.Module]) -> Any:
    """Return a copy of the first member with the parameters of all."""
    done: dict[int, _Stacked] = {}

    def replaced(module: Any, others: Sequence[Any]) -> nn.Module:
        if id(others[0]) in done:
            return done[id(others[0])]
        kind = STACKED.get(type(module))
        own = [*module.parameters(recurse=False)]
        if kind is not None and own[0].ndim > 2:  # zuko's stacks of linear layers
            kind = None
        if kind is not None or own:
            done[id(others[0])] = (kind or _Loop)(others)
            return done[id(others[0])]
        for name, child in module._modules.items():
            if child is not None:
                module._modules[name] = replaced(
                    child, [other._modules[name] for other in others]
                )
        return module

    return replaced(copy.deepcopy(members[0]), members)


@torch.no_grad()
def _keeps_rows(
    member: nn.Module, question: Question, example: Sequence[Tensor]
) -> bool:
    """Tell whether two members answer in one network as each does alone."""
    other = copy.deepcopy(member).eval()
    with seeded(0):
        for parameter in other.parameters():
            scale = parameter.abs().mean() + 0.01
            parameter.add_(0.1 * scale * torch.randn_like(parameter))
    first = copy.deepcopy(member).eval()
    alone = torch.cat([question(net, *example) for net in (first, other)])
    try:
        together = _stacked([first, other]).eval()
        if isinstance(together, _Loop):
            return True
        rows = [torch.cat([part, part]) for part in example]
        return torch.allclose(question(together, *rows), alone, rtol=1e-3, atol=1e-3)
    except (RuntimeError, ValueError, TypeError):
        return False
