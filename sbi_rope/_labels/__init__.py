"""What is known about the parameters of calibration pairs: exactly, or not."""

from sbi_rope._labels.given import given_labels, on_bounds
from sbi_rope._labels.labels import Labels
from sbi_rope._labels.moments import labelled_moments, labelled_targets
from sbi_rope._labels.nodes import Nodes, reference_of
from sbi_rope._labels.parameters import LabelledParameters, nodes_of, parameters_of

__all__ = [
    "LabelledParameters",
    "Labels",
    "Nodes",
    "given_labels",
    "labelled_moments",
    "labelled_targets",
    "nodes_of",
    "on_bounds",
    "parameters_of",
    "reference_of",
]
