"""The leaderboard of a folder, kept up to date by a thread while somebody looks."""

from __future__ import annotations

import threading
import time
from contextlib import closing
from pathlib import Path

from rejeu.core.errors import one_line
from rejeu.core.language import Language
from rejeu.lab.reporting.rows import time_of
from rejeu.lab.runs.config import RunConfig
from rejeu.lab.runs.environment import from_run
from rejeu.lab.studio.state import Studio
from rejeu.teaching.courses import leaderboard
from rejeu.teaching.courses.leaderboard import Entrant, Leaderboard, Unranked

EPISODES, SEED, SECONDS = 50, 0, 60.0
"""As ``rejeu class`` by default: episodes of each model, their seeds, and the time that a model has."""
LOOKED = 5.0
"""Seconds after the last look for which models are still evaluated."""
AGAIN = 20.0
"""Seconds after which a model that has changed is evaluated again, such as the best one of a run that trains."""


class Judging:
    """The results of the models below a folder. Mutable; a thread adds them while :meth:`look` is called."""

    def __init__(self, studio: Studio) -> None:
        self.studio, self.folder = studio, studio.folder
        self.now = ""
        """Name of the model that is evaluated; empty for none."""
        self.problem = ""
        """Why there is no leaderboard."""
        self.version = 0
        """Rises with each result."""
        self._env_id = ""
        self._results: dict[Path, Entrant | Unranked] = {}
        self._stamps: dict[Path, tuple[object, float]] = {}
        self._until = 0.0
        self._thread: threading.Thread | None = None

    def look(self) -> None:
        """Keeps the thread at work for a few seconds."""
        self._until = time.monotonic() + LOOKED
        if self._thread is None or not self._thread.is_alive():
            self._thread = threading.Thread(target=self._follow, daemon=True)
            self._thread.start()

    def board(self, language: Language) -> Leaderboard:
        """Returns the leaderboard of the results so far."""
        results = dict(self._results)
        return leaderboard.board_of(self.folder, sorted(results), self._env_id, EPISODES, results, language)

    def path_of(self, name: str) -> Path | None:
        """Returns the path below the folder of a model on the leaderboard: a file, or the folder of a run."""
        paths = sorted(self._results)
        path = next((path for path in paths if leaderboard.name_of(path, self.folder, paths) == name), None)
        if path is None:
            return None
        return (path.parent if leaderboard.is_of_run(path) else path).relative_to(self.folder)

    def _follow(self) -> None:
        while time.monotonic() < self._until:
            try:
                self._evaluate(leaderboard.models(self.folder))
                self.problem = ""
            except Exception as error:  # the environment can raise anything
                self.problem, self.now, self._results, self._stamps = one_line(error), "", {}, {}
                self.version += 1
            time.sleep(1.0)

    def _evaluate(self, paths: list[Path]) -> None:
        """Evaluates the models that are new, or have changed."""
        for path in self._results.keys() - {*paths}:
            del self._results[path], self._stamps[path]
            self.version += 1
        due = [path for path in paths if self._is_due(path)]
        if not due:
            return
        self._env_id = leaderboard.usual_env_id(paths)
        environment = from_run(RunConfig(env=self._env_id), self.folder, self.studio.typed(self._env_id))
        with closing(environment.vector(EPISODES, "gymnasium", SEED)) as env:
            for path in due:
                if time.monotonic() >= self._until:
                    break
                name = self.now = leaderboard.name_of(path, self.folder, paths)
                self._stamps[path] = time_of(path), time.monotonic()
                settings = EPISODES, SEED, SECONDS, None
                self._results[path] = leaderboard.result_of(path, name, self._env_id, env, *settings)
                self.version += 1
        self.now = ""

    def _is_due(self, path: Path) -> bool:
        stamp, when = self._stamps.get(path, (None, -AGAIN))
        return time_of(path) != stamp and time.monotonic() - when > AGAIN
