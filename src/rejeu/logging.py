"""Where numbers go while training: one ``write(step, metrics)`` for console, CSV and TensorBoard."""

from __future__ import annotations

import csv
from collections.abc import Mapping
from pathlib import Path
from typing import Protocol

from rejeu.errors import MissingExtra


class Sink(Protocol):
    """Something that takes metrics."""

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        """Takes the metrics of environment step ``step``; names are ``group/name``."""

    def close(self) -> None:
        """Finishes."""


class Console:
    """Prints a table, grouped by the part of the name before the slash."""

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        from rich import box
        from rich.console import Console as RichConsole
        from rich.table import Table

        table = Table(box=box.SIMPLE, show_header=False, title=f"step {step:,}", title_justify="left")
        table.add_column()
        table.add_column(justify="right")
        group = None
        for name, value in metrics.items():
            head, _, tail = name.partition("/")
            if head != group:
                table.add_row(f"[bold]{head}[/bold]", "")
                group = head
            table.add_row(f"  {tail}", f"{value:.4g}" if isinstance(value, float) else f"{value:,}")
        RichConsole().print(table)

    def close(self) -> None:
        pass


class CsvFile:
    """Appends rows to a CSV file; a row may bring new columns, which are then empty in those before it."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self.path.parent.mkdir(parents=True, exist_ok=True)
        self._file = self.path.open("w+", newline="", encoding="utf-8")
        self._writer: csv.DictWriter[str] = csv.DictWriter(self._file, [], restval="")

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        row = {"step": step, **metrics}
        if new := [name for name in row if name not in self._writer.fieldnames]:
            self._widen(new)
        self._writer.writerow(row)
        self._file.flush()

    def close(self) -> None:
        self._file.close()

    def _widen(self, new: list[str]) -> None:
        """Writes the whole file again with more columns."""
        self._file.seek(0)
        rows = list(csv.DictReader(self._file))
        self._file.seek(0)
        self._file.truncate()
        self._writer = csv.DictWriter(self._file, [*self._writer.fieldnames, *new], restval="")
        self._writer.writeheader()
        self._writer.writerows(rows)


class TensorBoard:
    """Writes scalars for TensorBoard into a folder."""

    def __init__(self, folder: str | Path) -> None:
        try:
            from tensorboard.summary import Writer
        except ImportError:
            raise MissingExtra("tensorboard_log", "tensorboard", "tensorboard") from None
        self._writer = Writer(str(folder))

    def write(self, step: int, metrics: Mapping[str, float]) -> None:
        for name, value in metrics.items():
            self._writer.add_scalar(name, value, step=step)

    def close(self) -> None:
        self._writer.flush()
        self._writer.close()


def next_folder(root: str | Path, name: str) -> Path:
    """Returns ``root/name_k`` with the first k from 1 that is free, as Stable-Baselines3 names its log folders."""
    root = Path(root)
    k = 1
    while (root / f"{name}_{k}").exists():
        k += 1
    return root / f"{name}_{k}"
