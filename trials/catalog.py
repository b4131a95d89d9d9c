"""Tries every environment of the packages that people use, and tabulates by family which work and why the others do not.

    python trials/catalog.py run gymnasium --out FOLDER --minutes 10   # resumes; once for each group
    python trials/catalog.py collect FOLDER                            # writes trials/results/catalog.json

Packages conflict with each other, so groups run in virtual environments of their own; docs/environments.md says which fit
together. Each environment is tried in two copies: it is made; two vectors with one seed give the same 20 steps; 1,000 random
steps of each copy are finite, and inside the declared bounds; episodes end at the time limit at the latest and are reset.
These steps take 15 seconds at most, and half a second where the same kind of observations and actions in the same family was
tried. The first ten of a family pass ``rejeu check``. One of each kind in a family is also trained for 500 steps by the
default algorithm, saved and loaded, and resumed from a checkpoint; the resumed run must equal the uninterrupted one, bit for
bit, where the state of the environment can be saved. A second id of EnvPool for the same environment is only made.

Environments run in batches in a process of their own: a crash or a step that takes too long is a row of the results.
"""

from __future__ import annotations

import argparse
import collections
import json
import os
import re
import resource
import signal
import subprocess
import sys
import tempfile
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import suppress
from importlib import import_module, metadata
from pathlib import Path
from typing import Any, NamedTuple

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from trials.provenance import provenance, read, write

RESULT = Path(__file__).parent / "results" / "catalog.json"
STEPS, SECONDS, KNOWN_SECONDS, SEEDED, CHECKED, TRAINED, CUT = 1_000, 15.0, 0.5, 20, 10, 500, 300
BATCH, LONGEST = 100, 300
"""Environments of one process, and seconds of one environment after which it counts as hung, by default."""
ENVIRONMENT = {
    "JAX_PLATFORMS": "cpu",
    "MUJOCO_GL": "disable",
    "SDL_VIDEODRIVER": "dummy",
    "XLA_FLAGS": "--xla_cpu_multi_thread_eigen=false --xla_backend_optimization_level=0",
}
CAUSES = {
    r"took longer than": "a step takes too long, or hangs",
    r"^crash": "crashes the process",
    r"Qt 5": "needs the libraries of Qt 5 on the system (apt install qtbase5-dev)",
    r"flax": "needs flax: pip install flax",
    r"shimmy\[gym-v|named 'gym'": "no environment, but a wrapper of those for Gym",
    r"compatibility-env": "no environment, but a wrapper of those for DeepMind's interface",
    r"old version|DeprecatedEnv|mujoco.py|needs mujoco": "an old version that can no longer be made; the newest one works",
    r"ConcatVecEnv resets": "SuperSuit's vector does not say how it resets, and is refused",
    r"has \d players|reward of shape": "has several players, each with its own rewards, and is refused",
    r"spaces not consistent": "its agents have different observations",
    r"No OpenGL": "its observations are pictures, and there was no OpenGL (MUJOCO_GL=egl)",
    r"PhysicsError": "random actions make its simulation invalid",
    r"flex_vertedge": 'dm-control 1.0.50 fails with MuJoCo 4.0: add "mujoco<4"',
    r"minigrid\[wfc": "needs more packages: pip install 'minigrid[wfc]'",
    r"loading texture": "its textures are not in the package",
    r"scenarios/\.cfg": "needs a scenario of your own, and EnvPool's environments take no arguments here",
    r"argument 'a_min'": "calls jax.numpy.clip by a name of its arguments that JAX 0.10 does not have",
    r"urlopen error": "downloads its images, and there was no network",
    r"Sudoku database": "its puzzles are not in the package",
    r"no algorithm here takes": "the actions are of a kind that no algorithm takes",
    r"the observation space at": "an observation is of a kind that no network takes (MiniGrid: ImgObsWrapper)",
}
"""What errors mean, by a pattern of their text; those of no pattern are shown as they are."""


class Group(NamedTuple):
    """Environments that fit into one virtual environment."""

    packages: tuple[str, ...]
    """Whose versions are recorded."""
    ids: Callable[[], dict[str, str]]
    """Returns the family of each id."""
    vector: Callable[[str], Any]
    """Returns two of them."""
    gymnasium_env: Callable[[str], Any] | None = None
    """Returns a Gymnasium environment for ``rejeu check``; None if there is none."""


def make_two(env_id: str, backend: str = "gymnasium", **kwargs: Any) -> Any:
    import rejeu

    return rejeu.make_vector(env_id, 2, backend, seed=0, **kwargs)  # type: ignore[arg-type]


def vector_of(env: Any) -> Any:
    """Returns two environments of a function, or a vector environment."""
    import rejeu

    return rejeu.make_vector(env, 2, seed=0)


def grid(env_id: str) -> Any:
    """Returns an environment of MiniGrid without its mission, which is a text."""
    from rejeu.envs.registry import make_env

    return import_module("minigrid.wrappers").ImgObsWrapper(make_env(env_id))


def registered(package: str) -> dict[str, str]:
    """Returns the ids that a package registers in Gymnasium, with the module as family."""
    import gymnasium as gym

    with suppress(Exception):
        gym.register_envs(import_module(package))
    families = {}
    for env_id, spec in gym.registry.items():
        entry = getattr(spec.entry_point, "func", spec.entry_point)
        origin = entry if isinstance(entry, str) else getattr(entry, "__module__", "")
        parts = [segment for segment in re.split(r"[.:]", origin) if segment != "envs"]
        if parts[0] == package:
            families[env_id] = parts[1] if len(parts) > 2 else package
    return families


def gymnasium_group(package: str, *also: str) -> Group:
    from rejeu.envs.registry import make_env

    return Group((package.replace("_", "-"), *also), lambda: registered(package), make_two, make_env)


def envpool_ids() -> dict[str, str]:
    envpool, registry = import_module("envpool"), import_module("envpool.registration").registry
    return {env_id: registry.specs[env_id][0].removeprefix("envpool.") for env_id in envpool.list_all_envs()}


def atari_ids(package: str) -> dict[str, str]:
    """Returns the present ids of all games, and the older ones of Pong."""
    return {env_id: "ale" for env_id in registered(package) if env_id.startswith(("ALE/", "Pong"))}


def atari_vector(env_id: str) -> Any:
    from gymnasium.vector import AutoresetMode

    name = re.sub(r"(?<!^)(?=[A-Z]|3D)", "_", env_id[4:-3]).lower().replace("3_d", "3d")
    make = import_module("ale_py.vector_env").AtariVectorEnv
    return vector_of(make(name, num_envs=2, autoreset_mode=AutoresetMode.SAME_STEP))


def pettingzoo_ids() -> dict[str, str]:
    families = {}
    for package in ("pettingzoo.butterfly", "pettingzoo.sisl", "mpe2"):
        with suppress(ImportError):
            folder = Path(next(iter(import_module(package).__path__)))
            families |= {path.stem: package for path in sorted(folder.glob("*_v*.py"))}
    return families


def pettingzoo_vector(name: str) -> Any:
    supersuit, module = import_module("supersuit"), import_module(f"{pettingzoo_ids()[name]}.{name}")
    env = supersuit.pettingzoo_env_to_vec_env_v1(supersuit.black_death_v3(module.parallel_env()))
    return vector_of(supersuit.concat_vec_envs_v1(env, 1, base_class="gymnasium"))


def metaworld(name: str) -> Any:
    import gymnasium as gym

    return gym.make("Meta-World/MT1", env_name=name, disable_env_checker=True)


def from_jax(package: str, name: str) -> Any:
    from rejeu.envs.functional import adapters

    if package == "brax":
        return vector_of(adapters.from_brax(import_module("brax.envs").get_environment(name)))
    return vector_of(adapters.from_gymnax(*import_module("gymnax").make(name)))


def groups() -> dict[str, Group]:
    return {
        "gymnasium": gymnasium_group("gymnasium", "mujoco"),
        "robotics": gymnasium_group("gymnasium_robotics", "mujoco"),
        "highway": gymnasium_group("highway_env"),
        "minigrid": Group(
            ("minigrid",), lambda: registered("minigrid"), lambda env_id: vector_of(lambda: grid(env_id)), grid
        ),
        "ale": gymnasium_group("ale_py")._replace(ids=lambda: atari_ids("ale_py")),
        "dm-control": gymnasium_group("shimmy", "dm-control", "mujoco"),
        "panda": gymnasium_group("panda_gym", "pybullet"),
        "envpool": Group(("envpool",), envpool_ids, lambda env_id: make_two(env_id, "envpool")),
        "ale-vector": Group(
            ("ale-py",),
            lambda: {env_id: "AtariVectorEnv" for env_id in atari_ids("ale_py") if env_id.startswith("ALE/")},
            atari_vector,
        ),
        "metaworld": Group(
            ("metaworld", "mujoco"),
            lambda: dict.fromkeys(import_module("metaworld").ALL_V3_ENVIRONMENTS, "metaworld"),
            lambda name: make_two("Meta-World/MT1", env_name=name),
            metaworld,
        ),
        "pettingzoo": Group(("pettingzoo", "mpe2", "supersuit"), pettingzoo_ids, pettingzoo_vector),
        "gymnax": Group(
            ("gymnax",),
            lambda: dict.fromkeys(import_module("gymnax").registered_envs, "gymnax"),
            lambda name: from_jax("gymnax", name),
        ),
        "brax": Group(
            ("brax", "mujoco"),
            lambda: dict.fromkeys(import_module("brax.envs")._envs, "brax"),
            lambda name: from_jax("brax", name),
        ),
    }


class Case:
    """The environment that is tried. Its stages are methods that return the value to record; None for ``"ok"``."""

    def __init__(self, group: Group, env_id: str, rows: list[dict[str, Any]], is_brief: bool) -> None:
        self.group, self.env_id, self.is_brief = group, env_id, is_brief
        self.rows = rows
        self.row: dict[str, Any] = {"id": env_id, "family": group.ids()[env_id]}
        self.of_family = [row for row in rows if row["family"] == self.row["family"]]

    def stages(self) -> Iterator[Callable[[], str | None]]:
        yield self.make
        if not self.row.get("same_as"):
            yield from (self.seed, self.step, self.bounds, self.end)
            if self.group.gymnasium_env is not None and sum("check" in row for row in self.of_family) < CHECKED:
                yield self.check
            if self.is_new_kind() and not self.is_brief:
                yield from (self.train, self.save, self.resume)

    def make(self) -> str | None:
        from rejeu.core.spaces import action_scaler, leaves

        self.vector = self.group.vector(self.env_id)
        space_kinds = ", ".join(sorted({leaf.kind for leaf in leaves(self.vector.observation_space)}))
        self.row["kind"] = f"{space_kinds} -> {type(self.vector.action_space).__name__}"
        self.obs = self.vector.reset()
        self.scale = action_scaler(self.vector.action_space)
        self.row["same_as"] = self.twin()
        return None

    def twin(self) -> str | None:
        """Returns the id that was tried already and is EnvPool's for the same environment."""
        if self.vector.backend != "envpool":
            return None
        specs = import_module("envpool.registration").registry.specs
        others = [row["id"] for row in self.rows if row["id"] != self.env_id and "same_as" not in row]
        same = [env_id for env_id in others if specs[env_id] == specs[self.env_id]]
        return same[0] if same else None

    def is_new_kind(self) -> bool:
        """Returns whether nothing of this kind was trained yet; one that failed is no reason not to try another."""
        same = [row for row in self.of_family if row.get("kind") == self.row["kind"]]
        return not any(row.get("resume") for row in same) and sum("train" in row for row in same) < 2

    def actions(self, rng: Any) -> Any:
        from rejeu.core.spaces import random_action

        return self.scale(random_action(self.vector.action_space, self.vector.n_envs, rng))

    def seed(self) -> str | None:
        import jax
        import numpy as np

        def equal(first: Any, second: Any) -> bool:
            pairs = zip(jax.tree.leaves(first), jax.tree.leaves(second), strict=True)
            return all(np.array_equal(a, b, equal_nan=a.dtype.kind == "f") for a, b in pairs)

        twin = self.group.vector(self.env_id)
        rng = np.random.default_rng(0)
        try:
            if not equal(self.obs, twin.reset()):
                return "resets differ"
            for i in range(SEEDED):
                action = self.actions(rng)
                result, twin_result = self.vector.step(action), twin.step(action)
                if not equal(result[:4], twin_result[:4]):
                    return f"step {i + 1} differs"
                if (done := result.terminated | result.truncated).any():
                    self.vector.reset_done(done), twin.reset_done(done)
            return None
        finally:
            twin.close()

    def step(self) -> str | None:
        import jax
        import numpy as np

        self.vector.reset()
        rng, length = np.random.default_rng(1), np.zeros(self.vector.n_envs, int)
        self.n_steps, self.n_terminated, self.n_truncated, self.longest, self.outside = 0, 0, 0, 0, ""
        until = time.monotonic() + (KNOWN_SECONDS if self.is_brief or not self.is_new_kind() else SECONDS)
        while self.n_steps < STEPS * self.vector.n_envs and time.monotonic() < until:
            result = self.vector.step(self.actions(rng))
            self.n_steps += self.vector.n_envs
            length += 1
            for values in (result.reward, *jax.tree.leaves(result.obs)):
                if np.asarray(values).dtype.kind == "f" and not np.isfinite(values).all():
                    raise ValueError(f"not finite in step {self.n_steps}")
            self.outside = self.outside or outside(self.vector.observation_space, result.obs)
            done = np.asarray(result.terminated | result.truncated)
            self.longest = max(self.longest, int(length.max()))
            self.n_terminated += int(np.sum(result.terminated))
            self.n_truncated += int(np.sum(np.asarray(result.truncated) & ~np.asarray(result.terminated)))
            if done.any():
                length[done] = 0
                fresh = self.vector.reset_done(done)
                self.outside = self.outside or outside(self.vector.observation_space, fresh)
        self.row |= {"steps": self.n_steps, "terminated": self.n_terminated, "truncated": self.n_truncated}
        return None

    def bounds(self) -> str | None:
        return self.outside or None

    def end(self) -> str | None:
        limit = self.vector.max_episode_steps
        if limit is not None and self.longest > limit:
            raise ValueError(f"an episode of {self.longest} steps, and the limit is {limit}")
        if self.n_terminated + self.n_truncated == 0:
            return f"none in {self.n_steps} steps, limit {limit}"
        return None

    def check(self) -> str | None:
        from rejeu.envs import checker

        assert self.group.gymnasium_env is not None
        env = self.group.gymnasium_env(self.env_id)
        try:
            errors = [finding.text for finding in checker.findings(env) if finding.level == "error"]
        finally:
            env.close()
        return "; ".join(errors)[:300] or None

    def agent(self) -> Any:
        import numpy as np

        import rejeu
        from rejeu.agents import choose_algorithm
        from rejeu.algorithms.config import OffPolicyConfig

        vector = self.group.vector(self.env_id)
        has_bounds = all(np.isfinite(getattr(vector.action_space, name, 0.0)).all() for name in ("low", "high"))
        name = choose_algorithm(None, self.env_id, vector.action_space) if has_bounds else "PPO"
        is_off_policy = isinstance(rejeu.AGENTS[name].algorithm.Config(), OffPolicyConfig)
        settings: dict[str, Any] = (
            {"buffer_size": 2_000, "batch_size": 32, "train_freq": 4} if is_off_policy else {"n_steps": 64}
        )
        nested = type(vector.observation_space).__name__ in ("Dict", "Tuple")
        self.row["algorithm"] = name
        return rejeu.AGENTS[name]("MultiInputPolicy" if nested else "MlpPolicy", vector, seed=0, **settings)

    def train(self) -> str | None:
        from tests.sharing import shared_learners

        with shared_learners():
            self.trained = self.agent().learn(TRAINED)
        if self.trained.num_timesteps != TRAINED or not self.trained.n_updates:
            raise ValueError(f"{self.trained.num_timesteps} steps with {self.trained.n_updates} updates")
        return None

    def save(self) -> str | None:
        import jax
        import numpy as np

        with tempfile.TemporaryDirectory() as folder:
            path = self.trained.save(Path(folder) / "model")
            loaded = type(self.trained).load(path or Path(folder) / "model")
        pairs = [agent.predict(self.obs, deterministic=True)[0] for agent in (self.trained, loaded)]
        if not all(map(np.array_equal, *map(jax.tree.leaves, pairs))):
            raise ValueError("the loaded agent acts otherwise")
        return None

    def resume(self) -> str | None:
        from rejeu.callbacks import Checkpoint
        from tests.sharing import shared_learners
        from trials.resume import facts, same

        def stop(agent: Any, turn: Any) -> bool:
            return turn.step < CUT

        with tempfile.TemporaryDirectory() as folder, shared_learners():
            broken = self.agent().learn(TRAINED, [stop, Checkpoint(folder, every=100)])
            again = type(broken).resume(folder, self.group.vector(self.env_id))
            exact = again.resumed.exact
            if not same(facts(again), facts(broken)):
                raise ValueError("the resumed run is not as it was")
            again.learn()
        if exact and not same(facts(again), facts(self.trained)):
            raise ValueError("the resumed run ends otherwise than the uninterrupted one")
        return None if exact else "from the start of new episodes"


def outside(space: Any, obs: Any) -> str:
    """Returns by how much a batch of observations is outside the bounds of its space, empty if it is not."""
    import numpy as np

    if hasattr(space, "spaces"):
        keys = space.spaces.keys() if isinstance(space.spaces, dict) else range(len(space.spaces))
        excesses = (outside(space.spaces[key], obs[key]) for key in keys)
        return next(filter(None, excesses), "")
    if type(space).__name__ == "Box":
        low, high, values = (np.asarray(a, np.float64) for a in (space.low, space.high, obs))
        beyond = np.maximum(low - values, values - high)
        largest = float(np.nanmax(beyond, initial=0.0))
        scale = float(np.abs(values).max(initial=1.0))
        return f"by {largest:.2g}" if largest > 1e-6 * scale else ""
    if type(space).__name__ == "Discrete":
        return "" if ((obs >= space.start) & (obs < space.start + space.n)).all() else "no such value"
    return ""


def said(error: BaseException) -> str:
    return f"{type(error).__name__}: {error}".replace("\n", " ")[:300]


def try_one(group: Group, env_id: str, rows: list[dict[str, Any]], is_brief: bool) -> dict[str, Any]:
    """Returns the row of one environment: each stage that was reached, and where and why the last one failed."""
    began = time.perf_counter()
    case = Case(group, env_id, rows, is_brief)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        stage: Callable[[], str | None]
        try:
            for stage in case.stages():
                case.row[stage.__name__] = stage() or "ok"
        except Exception as error:
            case.row |= {"failed": stage.__name__, "error": said(error)}
        with suppress(Exception):
            case.vector.close()
    case.row["seconds"] = round(time.perf_counter() - began, 1)
    return {key: value for key, value in case.row.items() if value is not None}


def untrained(rows: dict[str, dict[str, Any]]) -> list[str]:
    """Returns the first environment of each kind in a family of which none was trained."""
    rows_by_kind: dict[tuple[str, str], list[dict[str, Any]]] = collections.defaultdict(list)
    for row in rows.values():
        if "seed" in row and row.get("failed") in (None, "train", "save", "resume"):
            rows_by_kind[row["family"], row["kind"]].append(row)
    return [of_kind[0]["id"] for of_kind in rows_by_kind.values() if not any("train" in row for row in of_kind)]


def read_rows(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text(encoding="utf-8").splitlines()] if path.exists() else []


def append(path: Path, row: dict[str, Any]) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")
    print(json.dumps(row), flush=True)


def try_batch(name: str, path: Path, env_ids: list[str], is_brief: bool) -> None:
    """Tries some environments in this process, one after the other."""
    group = groups()[name]
    for env_id in env_ids:
        append(path, try_one(group, env_id, read_rows(path), is_brief))


def run(name: str, folder: Path, minutes: float, longest: float, only: list[str], brief: bool) -> None:
    """Tries the environments of a group that have no row yet."""
    folder.mkdir(parents=True, exist_ok=True)
    path, group = folder / f"{name}.jsonl", groups()[name]
    families = group.ids()
    rows = {row["id"]: row for row in read_rows(path)}
    todo = [env_id for env_id in only or families if env_id not in rows] + ([] if brief else untrained(rows))
    until = time.monotonic() + 60 * minutes
    while todo and time.monotonic() < until:
        batch, n_before = todo[:BATCH], len(read_rows(path))
        command = [
            sys.executable,
            __file__,
            "batch",
            name,
            "--out",
            str(folder),
            *["--brief"] * brief,
            "--only",
            *batch,
        ]
        with tempfile.TemporaryFile("w+") as errors:
            child = subprocess.Popen(command, env={**os.environ, **ENVIRONMENT}, stderr=errors, start_new_session=True)
            n, since, is_late = n_before, time.monotonic(), False
            while child.poll() is None:
                time.sleep(0.2)
                if (now := len(read_rows(path))) != n:
                    n, since = now, time.monotonic()
                is_late = time.monotonic() - since > longest
                if is_late or time.monotonic() > until + longest:
                    child.kill()
                    child.wait()
            with suppress(ProcessLookupError):
                os.killpg(child.pid, signal.SIGKILL)  # the programs that environments started and left
            errors.seek(0)
            last = (errors.read().strip().splitlines() or [""])[-1][:200]
        todo = todo[len(read_rows(path)) - n_before :]
        is_cut = time.monotonic() > until + longest and not is_late  # in the middle of one that may be quick
        if child.returncode and todo and todo[0] in batch and not is_cut:
            why = f"took longer than {longest:g} s" if is_late else f"crash, exit status {child.returncode}: {last}"
            row = {"id": todo[0], "family": families[todo[0]], "failed": "process", "error": why}
            append(path, {**row, "seconds": round(time.monotonic() - since, 1)})
            todo = todo[1:]
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    before = read(folder / f"{name}.json")
    names = {str(folder): "FOLDER"}
    origin = {**provenance(names), "ids": len(families), "versions": {p: version(p) for p in group.packages}}
    origin["families"] = collections.Counter(families.values())
    origin["cpu_minutes"] = round(before.get("cpu_minutes", 0.0) + (used.ru_utime + used.ru_stime) / 60, 1)
    write(folder / f"{name}.json", origin)
    print(f"{name}: {len(todo)} of {len(families)} left, {origin['cpu_minutes']} minutes of processor time")


def version(package: str) -> str | None:
    with suppress(metadata.PackageNotFoundError):
        return metadata.version(package)
    return None


def cause(row: dict[str, Any]) -> str:
    """Returns why an environment failed, empty if it did not."""
    if "failed" not in row:
        return "" if row.get("check", "ok") == "ok" else f"check: {row['check']}"
    text = row["error"]
    return next(
        (meaning for pattern, meaning in CAUSES.items() if re.search(pattern, text)), f"{row['failed']}: {text}"
    )


def collect(folder: Path) -> None:
    """Writes the table of all groups: a line for each family, and the ids that failed or stood out, by cause.

    Groups and families that the folder does not have stay as the table has them.
    """
    result: dict[str, Any] = {**provenance({str(folder): "FOLDER"}), "groups": {}, "families": [], "failures": []}
    before = read(RESULT)
    new = {(path.stem, row["family"]) for path in folder.glob("*.jsonl") for row in read_rows(path)}
    result["groups"] = dict(before.get("groups", {}))
    for section in ("families", "failures"):
        result[section] = [row for row in before.get(section, []) if (row["group"], row["family"]) not in new]
    for path in sorted(folder.glob("*.jsonl")):
        name, rows = path.stem, [*{row["id"]: row for row in read_rows(path)}.values()]
        result["groups"][name] = json.loads(path.with_suffix(".json").read_text(encoding="utf-8"))
        by_family, by_cause = collections.defaultdict(list), collections.defaultdict(list)
        for row in rows:
            by_family[row["family"]].append(row)
            if why := cause(row):
                by_cause[row["family"], why].append(row["id"])
        n_ids = result["groups"][name].pop("families", {})
        recorded = {row["family"] for row in result["families"] if row["group"] == name}
        for family in sorted({*by_family, *n_ids} - recorded):
            of_family = by_family[family]
            resumed = [row["resume"] for row in of_family if "resume" in row]
            result["families"].append({
                "group": name, "family": family, "ids": n_ids.get(family, len(of_family)),
                "tried": len(of_family),
                "work": sum(not cause(row) for row in of_family),
                "same_episodes_by_seed": sum(row.get("seed") == "ok" for row in of_family),
                "inside_bounds": sum(row.get("bounds", "ok") == "ok" and "seed" in row for row in of_family),
                "trained": ", ".join(sorted({row["algorithm"] for row in of_family if row.get("train") == "ok"})),
                "resumed_exactly": f"{resumed.count('ok')} of {len(resumed)}" if resumed else "",
                "seconds": round(sum(row["seconds"] for row in of_family)),
            })  # fmt: skip
        for (family, why), ids in sorted(by_cause.items()):
            result["failures"].append({"group": name, "family": family, "cause": why, "number": len(ids), "ids": ids})
    result |= {key: sum(row[key] for row in result["families"]) for key in ("ids", "tried", "work")}
    for section in ("families", "failures"):
        result[section].sort(key=lambda row: row["group"])
    write(RESULT, result)
    print({key: result[key] for key in ("ids", "tried", "work")})


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("action", choices=["run", "batch", "collect"])
    parser.add_argument("group")
    parser.add_argument("--out", type=Path)
    parser.add_argument("--minutes", type=float, default=10.0)
    parser.add_argument("--brief", action="store_true", help="train nothing yet: a later run without this does")
    parser.add_argument("--longest", type=float, default=LONGEST, help="seconds of one environment")
    parser.add_argument("--only", nargs="*", default=[])
    arguments = parser.parse_args()
    if arguments.action == "collect":
        collect(Path(arguments.group))
    elif arguments.action == "run":
        run(arguments.group, arguments.out, arguments.minutes, arguments.longest, arguments.only, arguments.brief)
    else:
        try_batch(arguments.group, arguments.out / f"{arguments.group}.jsonl", arguments.only, arguments.brief)


if __name__ == "__main__":
    main()
