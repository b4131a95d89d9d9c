"""The form on the page of a run that begins another run from one of its checkpoints, with other settings."""

from __future__ import annotations

import shlex
from pathlib import Path

from nicegui import ui

from rejeu.checkpoints.run_folder import RunFolder, checkpoint_files, step_of
from rejeu.lab.runs import parsing
from rejeu.lab.runs.arguments import Branch
from rejeu.lab.studio.layout import form_buttons
from rejeu.lab.studio.new import lead_to, new_folder
from rejeu.lab.studio.speech import say
from rejeu.lab.studio.state import Studio


def open_form(studio: Studio, name: str, path: Path) -> None:
    """Opens the form over the page of a run; ``name`` is that of its row."""
    steps = {step_of(file): f"{step_of(file):,}" for file in checkpoint_files(RunFolder(path).checkpoints)}
    row = studio.row(name)
    further = str(row.steps) if row is not None and row.state == "finished" else ""  # it has reached its goal
    with ui.dialog(value=True) as form, ui.card().classes("w-full").style("max-width: 30rem"):
        ui.label(say("A new run from a checkpoint of this one")).classes("text-weight-medium")
        step = ui.select(steps, label=say("from step"), value=next(iter(steps), None)).classes("w-full")
        settings = ui.input(say("settings that change"), placeholder="learning_rate=1e-4 gamma=0.9").classes("w-full")
        more = ui.input(say("train for so many more steps"), value=further).classes("w-full")
        more.props.update(hint=say("empty: to the goal of this run"))
        folder = ui.input(say("new folder"), value=f"{name}-branch").classes("w-full")
        message = ui.label().classes("text mono")

        async def begin() -> None:
            button.disable()
            try:
                out = new_folder(studio, folder.value or "")
                words = ["branch", str(path), "--at", str(step.value), "--out", str(out), *studio.words(name)]
                words += ["--steps", more.value] if more.value else []
                words += ["--set", *shlex.split(settings.value)] if settings.value else []
                parsing.parse(words, {"branch": Branch}, {}, "")
                message.text = await lead_to(studio, words, out, message.set_text)
            except (ValueError, OSError) as error:
                message.text = str(error)
            button.enable()

        button = form_buttons(form, say("Start"), begin, "call_split")
        if not steps:
            button.disable()
            message.text = say("This run has no checkpoint yet.")
