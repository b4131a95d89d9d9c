"""The progress of training, as a bar or as lines, and how its time is spent."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, NamedTuple, Self

from rejeu.callbacks.base import TrainingCallback, step_before
from rejeu.core import xla
from rejeu.logs import formatting
from rejeu.training.run import Progress, TrainingCall, time_shares

if TYPE_CHECKING:
    from rich.console import Console


REFRESH_SECONDS = 0.125
"""Least time between two refreshes of the progress bar on a terminal."""
NOTEBOOK_SECONDS = 0.5
"""Least time between two refreshes in a notebook, where each is a message to the browser."""
LINE_SECONDS = 10.0
"""Least time between two lines of progress if the output is not a terminal."""
LONG_TRACE = 0.1
"""Seconds of tracing from which on a function takes a while to compile."""
RATE_SECONDS = 10.0
"""Interval over which steps per second and shares of time are measured."""


NAMES = {"replay": "buffer"}
"""How parts of the time are shown: PPO and A2C have a rollout buffer."""
BAR_WIDTH = 40
"""Characters of the bar."""


class _Mark(NamedTuple):
    """The progress of a run at one time."""

    time: float
    step: int
    seconds: dict[str, float]
    """See :attr:`Agent.seconds`."""


class ProgressBar(TrainingCallback):
    """Shows the progress of training: a bar on a terminal or in a notebook, elsewhere a line every ten seconds.

    Below the bar, or at the end of the line, are the shares of time spent on the environment's steps and resets, the buffer of
    experience, the update (off-policy: the time the loop waited for the device) and everything else.
    """

    def __init__(
        self,
        n_steps: int | None,
        seconds: float | None,
        console: Console | None = None,
        steps_before: int = 0,
        spent: float = 0.0,
    ) -> None:
        """Starts the clock; the bar appears with the first step.

        Args:
            n_steps: environment steps to take; None without such a limit.
            seconds: time to take, without compilation; None without such a limit.
            console: where to write; None: standard output.
            steps_before: steps of a resumed run that were taken before.
            spent: time that it had taken before, in seconds.
        """
        from rich.live import Live

        self.n_steps, self.seconds = n_steps, seconds
        self._console = formatting.console() if console is None else console
        self._display = formatting.Display() if self._console.is_jupyter else None
        is_animated = self._console.is_terminal and not self._console.is_dumb_terminal
        self._live = Live(console=self._console, auto_refresh=False) if is_animated else None
        period = REFRESH_SECONDS if is_animated else LINE_SECONDS
        self._period = NOTEBOOK_SECONDS if self._display is not None else period
        self._began = xla.clock()
        self._refresh_at = -math.inf
        self._taken, self._spent = steps_before, spent
        self._first_step = 0
        self._step_before: int | None = None
        self._latest: tuple[Any, int] | None = None
        self._shown_step = -1
        self._marks: deque[_Mark] = deque()

    @classmethod
    def of(cls, call: TrainingCall, steps_before: int = 0) -> Self:
        """Returns the bar of a call of ``learn``, of which ``steps_before`` steps were taken before it was resumed."""
        n_steps = None if call.last_step is None else call.last_step - call.first_step
        return cls(n_steps, call.seconds, steps_before=steps_before, spent=call.spent)

    def before_training(self, agent: Any) -> None:
        """Notes the step at which training begins, since the bar is first called after a turn, or after many at once."""
        self._step_before = agent.run.step
        xla.on_compile = lambda event, seconds: (
            self._show("compiling") if seconds > LONG_TRACE and "trace" in event else None
        )

    def __call__(self, agent: Any, progress: Progress) -> None:
        """Refreshes the bar if it is due."""
        now = xla.clock()
        if self._latest is None:
            self._start(agent, progress, now)
        self._latest = agent, progress.step
        if now >= self._refresh_at:
            self._refresh(agent, progress.step, now)

    def after_training(self, agent: Any, error: BaseException | None) -> None:
        """Closes it."""
        self.close()

    def _show(self, *texts: str, share: float | None = None) -> None:
        """Shows texts below a bar, where that can be replaced by the next, else on a line."""
        from rich.text import Text

        below = "\n".join([*([] if share is None else [bar(share)]), *texts])
        if self._live is not None:
            self._live.start()
            self._live.update(Text(below), refresh=True)
        elif self._display is not None:
            self._display.show(below)
        else:
            line = ("" if share is None else f"{share:4.0%}  ") + " · ".join(texts)
            self._console.print(line, soft_wrap=True, highlight=False, markup=False)
            self._console.file.flush()

    def close(self) -> None:
        """Shows the last step and releases the terminal."""
        xla.on_compile = lambda event, seconds: None
        if self._latest is not None and self._latest[1] != self._shown_step:
            self._refresh(*self._latest, xla.clock())
        if self._live is not None:
            self._live.stop()

    def _start(self, agent: Any, progress: Progress, now: float) -> None:
        before = step_before(agent, progress) if self._step_before is None else self._step_before
        self._first_step = before - self._taken
        self._marks.append(_Mark(self._began, before, agent.seconds))
        if self._live is None and self._display is None:
            self._refresh_at = now + LINE_SECONDS

    def _refresh(self, agent: Any, step: int, now: float) -> None:
        self._shown_step = step
        self._refresh_at = now + self._period
        self._marks.append(_Mark(now, step, agent.seconds))
        while len(self._marks) > 2 and self._marks[1].time <= now - RATE_SECONDS:
            self._marks.popleft()
        then, done = self._marks[0], step - self._first_step
        rate = (step - then.step) / max(now - then.time, 1e-9)
        shares, seconds_left = [], []
        if self.n_steps is not None:
            shares.append(done / self.n_steps)
            mean_rate = (done - self._taken) / max(now - self._began, 1e-9)  # of evaluations and their pauses too
            seconds_left.append(max(self.n_steps - done, 0) / max(mean_rate, 1e-9))
        if self.seconds is not None:
            spent_seconds = self._spent + now - self._began
            shares.append(spent_seconds / self.seconds)
            seconds_left.append(max(self.seconds - spent_seconds, 0.0))
        share = min(max(shares, default=0.0), 1.0)
        text = status(
            done, self.n_steps, rate, _mean(e["r"] for e in agent.ep_info_buffer), _mean(agent.ep_success_buffer),
            min(seconds_left, default=math.nan),
        )  # fmt: skip
        self._show(*filter(None, (text, time_spent(then.seconds, agent.seconds))), share=share)


def bar(share: float) -> str:
    """Returns a bar of text for a share in [0, 1].

    >>> bar(0.25)
    '██████████░░░░░░░░░░░░░░░░░░░░░░░░░░░░░░  25%'
    """
    full = round(share * BAR_WIDTH)
    return f"{'█' * full}{'░' * (BAR_WIDTH - full)} {share:4.0%}"


def status(
    step: int, n_steps: int | None, rate: float, mean_return: float, success_rate: float, seconds_left: float
) -> str:
    """Returns one line on a run: steps, steps per second, return, success rate, time left; NaN is left out.

    >>> status(1500, 20_000, 812.3, -1204.5, math.nan, 22.8)
    '1,500/20,000 steps · 812/s · return -1,204.50 · 23 s left'
    """
    parts = [f"{step:,}" + ("" if n_steps is None else f"/{n_steps:,}") + " steps", f"{rate:,.0f}/s"]
    if not math.isnan(mean_return):
        parts.append(f"return {mean_return:,.2f}")
    if not math.isnan(success_rate):
        parts.append(f"success {success_rate:.0%}")
    if not math.isnan(seconds_left):
        parts.append(f"{formatting.duration(round(seconds_left))} left")
    return " · ".join(parts)


def time_spent(before: Mapping[str, float], after: Mapping[str, float]) -> str:
    """Returns how the time between two values of ``agent.seconds`` was spent, empty if there is none.

    >>> time_spent(
    ...     {"env": 1.0, "replay": 0.5, "update": 3.0, "total": 5.0},
    ...     {"env": 2.2, "replay": 1.4, "update": 10.0, "total": 15.0},
    ... )
    'env 12% · buffer 9% · update 70% · rest 9%'
    """
    passed = {activity: after[activity] - before[activity] for activity in after}
    if passed["total"] <= 0.0:
        return ""
    shares = time_shares(passed).items()
    return " · ".join(f"{NAMES.get(activity, activity)} {max(share, 0.0):.0%}" for activity, share in shares)


def _mean(values: Iterable[float]) -> float:
    values = list(values)
    return sum(values) / len(values) if values else math.nan
