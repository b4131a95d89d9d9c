"""``rejeu train``: from the id of an environment to a run folder with a trained agent, a learning curve and a video."""

from __future__ import annotations

from contextlib import ExitStack

from rejeu.core.interrupt import Interrupt
from rejeu.core.types import JsonObject
from rejeu.lab.reporting.report import write_report
from rejeu.lab.runs.arguments import Train
from rejeu.lab.runs.begin import begin, with_dataset
from rejeu.lab.runs.output import Stopwatch, echo, header


def run_train(arguments: Train) -> tuple[int, JsonObject]:
    """Trains; the exit status is 0, 2 if something could not be written, 130 after Ctrl-C, 143 after SIGTERM."""
    if arguments.offline is not None:
        arguments = with_dataset(arguments)
    if arguments.seeds is not None:
        from rejeu.lab.cli import sweep

        return sweep.train_together(arguments) if sweep.fit_together(arguments) else sweep.train_all(arguments)
    stopwatch = Stopwatch()
    with ExitStack() as stack:
        session, stop = begin(arguments, stack, write_report), stack.enter_context(Interrupt())
        if arguments.assist:
            from rejeu.teaching.play import assist

            assist.check(session.agent)
        session = session.in_new_folder(arguments.out)
        if arguments.assist:
            session = session._replace(more=(assist.Assist(session.folder.path / "assisted", fps=arguments.fps),))
        echo(header(session.config, session.environment, session.backend, session.folder))
        return session.run(stop, stopwatch)
