"""Evaluation in the course of training, and the comparison of evaluations."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np

from rejeu.callbacks.base import TrainingCallback, crossed, step_before
from rejeu.core.types import JsonObject
from rejeu.core.validation import whole
from rejeu.envs.make import VectorEnv, make_vector
from rejeu.logs.evaluation import Evaluation
from rejeu.training.run import Progress

EVALUATED = ("returns", "lengths", "successes")
"""The arrays of an :class:`Evaluation`."""
EVALUATION = 0x4556
"""Added to the seeds of evaluations, so that they differ from all others."""


class Evaluated(NamedTuple):
    """One evaluation during a run."""

    step: int
    """Total environment steps at that time."""
    evaluation: Evaluation
    """Its result."""


class Evaluate(TrainingCallback):
    """Evaluates the deterministic policy at an interval of steps, in separate environments, and keeps the best model.

    ``agent.restore_best()`` restores the best weights. An evaluation that Ctrl-C ends has no result; the resumed run
    repeats it.

    >>> import rejeu
    >>> evaluate = Evaluate("Pendulum-v1", every=200, episodes=2, seed=0)
    >>> agent = rejeu.SAC("MlpPolicy", "Pendulum-v1", learning_starts=400, seed=0).learn(400, evaluate)
    >>> [result.step for result in evaluate.results]
    [200, 400]
    """

    def __init__(
        self,
        env: str | gym.Env | Callable[[], gym.Env] | gym.vector.VectorEnv | VectorEnv,
        every: int,
        episodes: int = 20,
        best_path: str | Path | None = None,
        seed: int | None = None,
        report: Callable[[Evaluated, bool], object] | None = None,
    ) -> None:
        """Makes the environments immediately, so that a wrong id raises before training.

        Args:
            env: as for the agent; of an id or a function up to 16 environments are made. Never the training environments.
            every: environment steps between two evaluations.
            episodes: of each evaluation.
            best_path: file for the best model so far; None saves none. If it cannot be written, training continues with a
                warning, and the write is repeated later.
            seed: of the evaluations, combined with the step of each; None uses the agent's.
            report: called with each result and whether it is the best so far.
        """
        self.every = whole("every", every, least=1)
        self.episodes = whole("episodes", episodes, least=1)
        self.best_path = None if best_path is None else Path(best_path)
        self.report = report
        self.results: list[Evaluated] = []
        """Every evaluation so far, oldest first."""
        self.best: Evaluated | None = None
        """The best so far: by success rate, then by mean return."""
        self._made_here = isinstance(env, str) or callable(env)
        self.env = make_vector(env, min(self.episodes, 16) if self._made_here else 1, seed=seed)
        self.seed = seed
        self._last_step: int | None = None
        self._is_due = False

    def __call__(self, agent: Any, progress: Progress) -> None:
        """Evaluates if an evaluation is due."""
        before = step_before(agent, progress) if self._last_step is None else self._last_step
        self._last_step = progress.step
        if crossed(before, progress.step, self.every):
            self.run(agent, progress.step)

    def resumed(self, agent: Any) -> None:
        """Repeats the evaluation at which the run was stopped."""
        if self._is_due:
            self.run(agent, agent.run.step)

    def run(self, agent: Any, step: int) -> Evaluated:
        """Evaluates now, regardless of ``every``; keeps and returns the result.

        Raises:
            ValueError: if the environments are those that the agent trains on.
            Stopped: if Ctrl-C or SIGTERM asks training to stop.
        """
        if agent.run.env is not None and agent.run.env.identities() & self.env.identities():
            raise ValueError("Evaluate was given the environments that the agent trains on; give it others, or an id")
        self._is_due = True
        root = agent.seed if self.seed is None else self.seed
        seed = int(np.random.SeedSequence([root, step, EVALUATION]).generate_state(1)[0])
        result = Evaluated(step, agent.evaluate(self.episodes, env=self.env, seed=seed))
        self.results.append(result)
        self._is_due = False
        is_best = self.best is None or merit(result.evaluation) > merit(self.best.evaluation)
        if is_best:
            self.best = result
            agent.remember_best(merit(result.evaluation), "evaluation")
            if self.best_path is not None:
                save = agent.snapshot(self.best_path)
                agent.failed_writes.attempt(f"best model {self.best_path}", save, is_model=True)
        agent.logger.write(step, logged(result.evaluation))
        if self.report is not None:
            self.report(result, is_best)
        return result

    def state_dict(self) -> JsonObject:
        """Returns its results for a checkpoint."""
        parts = [r.evaluation for r in self.results]
        columns = {key: [getattr(evaluated, key) for evaluated in parts] for key in EVALUATED}
        return {
            "steps": np.array([r.step for r in self.results], np.int64),
            "counts": np.array([len(evaluated.returns) for evaluated in parts], np.int64),
            "cut": np.array([evaluated.cut for evaluated in parts], np.int64),
            **{key: np.concatenate([np.zeros(0), *arrays]) for key, arrays in columns.items()},
            "best": None if self.best is None else self.results.index(self.best),
            "due": self._is_due,
        }

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Restores what :meth:`state_dict` returned."""
        ends = np.cumsum(state["counts"])[:-1]
        returns, lengths, successes = (np.split(state[key], ends) for key in EVALUATED)
        parts = zip(state["steps"].tolist(), returns, lengths, successes, state["cut"].tolist(), strict=False)
        self.results = [Evaluated(step, Evaluation(r, n.astype(int), s, c)) for step, r, n, s, c in parts]
        self.best = None if state["best"] is None else self.results[state["best"]]
        self._is_due = state["due"]

    def close(self) -> None:
        """Closes the environments, unless they were given as objects."""
        if self._made_here:
            self.env.close()


def logged(evaluation: Evaluation) -> dict[str, float]:
    """Returns an evaluation as metrics, under the names of Stable-Baselines3."""
    metrics = {"eval/mean_reward": evaluation.mean_return, "eval/mean_ep_length": evaluation.mean_length}
    if not math.isnan(evaluation.success_rate):
        metrics["eval/success_rate"] = evaluation.success_rate
    return metrics


def merit(evaluation: Evaluation) -> tuple[float, float]:
    """Returns the key to compare evaluations by: success rate, -1 if it is unknown, and mean return, -inf if it is NaN."""
    rate, value = evaluation.success_rate, evaluation.mean_return
    return (-1.0 if math.isnan(rate) else rate), (-math.inf if math.isnan(value) else value)
