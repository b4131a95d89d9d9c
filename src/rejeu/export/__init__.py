"""Trained policies as files of other formats, which act as ``predict`` does: ONNX, C, StableHLO, NumPy and pages.

The deterministic policy is traced as one pure function, from raw observations to actions of the environment, into a
:class:`~rejeu.export.program.TracedProgram`. Each format is a translation of its operations. A new one is a module with a
function ``files`` and an entry in :data:`FORMATS`.
"""

from __future__ import annotations

import tomllib
from importlib import import_module
from pathlib import Path
from typing import Any, Literal, NamedTuple

PRIMITIVES = tomllib.loads((Path(__file__).parent / "primitives.toml").read_text(encoding="utf-8"))
"""Primitives of each element by itself, in each format."""


class Format(NamedTuple):
    """The properties of a format."""

    module: str
    """It writes the files: ``files(source)``, of an :class:`~rejeu.export.contract.Exportable`."""
    suffix: str
    runner: str
    """The program that runs such a file, so that it can be compared with ``predict``."""
    takes: Literal["one", "any", "each"] = "each"
    """Observations at once: one, any number, or a fixed one too (``each``)."""
    noise: bool = True
    """Whether random numbers can be inputs."""
    frames: bool = True
    """Whether single frames of stacks can be inputs."""

    def files(self, source: object) -> Any:
        """Returns the contents of the files of a policy, and the run of the first; None if it cannot be run here."""
        return import_module(self.module).files(source)

    def check(self, name: str, noise: bool, batch: object, frame_stack: int | None) -> None:
        """Raises ``ValueError`` if the format does not take these arguments."""
        if noise and not self.noise:
            raise ValueError(f"noise=True: {name} contains the deterministic policy; leave it out")
        if frame_stack is not None and not self.frames:
            raise ValueError(f"frame_stack={frame_stack}: {name} takes observations as predict does; leave it out")
        if self.takes == "one" and batch not in (None, 1):
            raise ValueError(f"batch={batch}: {name} takes one observation at a time; leave it out")
        if self.takes == "any" and batch is not None:
            raise ValueError(f"batch={batch}: {name} takes any number of observations; leave it out")
        if batch is not None and (isinstance(batch, bool) or not isinstance(batch, int) or batch < 1):
            raise ValueError(f"batch={batch!r} must be a number of observations, or None for any number")


FORMATS = {
    "onnx": Format("rejeu.export.onnx_file", ".onnx", "onnxruntime"),
    "c": Format("rejeu.export.c_file", ".c", "a C compiler (cc, gcc or clang)", takes="one"),
    "stablehlo": Format("rejeu.export.stablehlo_file", ".stablehlo", "JAX"),
    "npz": Format("rejeu.export.npz_file", ".npz", "NumPy", takes="any", noise=False, frames=False),
    "web": Format("rejeu.export.web_file", ".html", "Node.js", takes="one", noise=False),
}
"""The formats by name. Their modules are imported when they are used: ONNX needs an extra."""


def target_of(path: Path, to: str | None) -> str:
    """Returns the format of a file: ``to``, or that of the suffix of ``path``.

    Raises:
        ValueError: if there is no such format.
    """
    suffixes = {export_format.suffix: name for name, export_format in FORMATS.items()}
    target = to if to is not None else suffixes.get(path.suffix)
    if target not in FORMATS:
        wrong = f"to={to!r}" if to is not None else f"the suffix of {str(path)!r}"
        raise ValueError(
            f"{wrong} is no format that a policy can be exported to; there are "
            + ", ".join(f"{name} ({suffix})" for suffix, name in suffixes.items())
        )
    return target
