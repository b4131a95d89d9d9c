"""Environments with one fault each. :data:`EVERY` lists the expected messages.

``checked`` is part of an error or warning of ``rejeu.check_env``. ``trained`` is part of the ``BadEnvironmentError``
that ends training. It is None if training continues, because the fault is corrected or cannot be detected during
training.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import gymnasium as gym
import numpy as np
from gymnasium import spaces

from tests.environments import Reach


class Good(gym.Env):
    """A valid environment: a walk of ten steps. Observations are a random number, the time and the position."""

    observation_space: spaces.Space = spaces.Box(-20.0, 20.0, (3,), np.float32)
    action_space = spaces.Box(-1.0, 1.0, (1,), np.float32)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict]:
        super().reset(seed=seed)
        self.time, self.place, self.drawn = 0, 0.0, float(self.np_random.uniform())
        return self.observe(), {}

    def step(self, action: Any) -> tuple[Any, Any, Any, Any, dict]:
        self.time += 1
        self.place += float(action[0])
        return self.observe(), self.place, False, self.time == 10, {}

    def observe(self) -> Any:
        return np.array([self.drawn, self.time, self.place], np.float32)

    @property
    def late(self) -> bool:
        """Whether the fault occurs: from the third step on."""
        return self.time >= 3


def seeing(name: str, observe: Callable[[Good], Any], space: spaces.Space = Good.observation_space) -> type[Good]:
    """Returns an environment of ``space`` whose observations are ``seen(env)``."""
    return type(name, (Good,), {"observe": observe, "observation_space": space, "__module__": __name__})


def later(name: str, bad: Any) -> type[Good]:
    """Returns an environment that is observed as ``bad`` from the third step on."""
    return seeing(name, lambda env: bad if env.late else Good.observe(env))


PAIR = spaces.Box(-1, 1, (2,), np.float32)
FloatAsImage = seeing(
    "FloatAsImage", lambda env: np.full((2, 2, 3), 0.5 if env.late else 0.0), spaces.Box(0, 255, (2, 2, 3), np.uint8)
)
Double = seeing("Double", lambda env: Good.observe(env).astype(np.float64))
AsList = seeing("AsList", lambda env: Good.observe(env).tolist())
Scalar = later("Scalar", np.float32(1.0))  # which NumPy would broadcast to all three elements
TooLong = later("TooLong", np.zeros(4, np.float32))
NothingSeen = later("NothingSeen", None)
NanSeen = later("NanSeen", np.array([0.0, np.nan, 0.0], np.float32))
NestedShape = seeing(
    "NestedShape",
    lambda env: {"arm": {"angles": np.zeros(3 if env.late else 2, np.float32)}, "step": env.time},
    spaces.Dict({"arm": spaces.Dict({"angles": PAIR}), "step": spaces.Discrete(11)}),
)
TupleShape = seeing(
    "TupleShape",
    lambda env: (np.zeros(2, np.float32), np.zeros(2, int) if env.late else 1),
    spaces.Tuple([PAIR, spaces.Discrete(11)]),
)
MissingKey = seeing(
    "MissingKey",
    lambda env: {key: np.zeros(2, np.float32) for key in ("left", "right")[: 1 if env.late else 2]},
    spaces.Dict({"left": PAIR, "right": PAIR}),
)
OutOfBounds = seeing(
    "OutOfBounds",
    lambda env: {"speed": np.array([0.0, 7.5 if env.late else 0.0], np.float32)},
    spaces.Dict({"speed": PAIR}),
)


def answering(name: str, change: Callable[..., tuple]) -> type[Good]:
    """Returns an environment whose steps return ``answer(obs, reward, terminated, truncated, info)`` from the third on."""

    def step(self: Good, action: Any) -> Any:
        result = Good.step(self, action)
        return change(*result) if self.late else result

    return type(name, (Good,), {"step": step, "__module__": __name__})


FourValues = answering("FourValues", lambda obs, reward, ended, cut, info: (obs, reward, ended or cut, info))
NoReward = answering("NoReward", lambda obs, reward, *others: (obs, None, *others))
NanReward = answering("NanReward", lambda obs, reward, *others: (obs, float("nan"), *others))
HugeReward = answering("HugeReward", lambda obs, reward, *others: (obs, 1e300, *others))
EndlessReward = answering("EndlessReward", lambda obs, reward, *others: (obs, 10**400, *others))
RewardArray = answering("RewardArray", lambda obs, reward, *others: (obs, np.array([reward, reward]), *others))
RewardOfOne = answering("RewardOfOne", lambda obs, reward, *others: (obs, np.array([reward]), *others))
RewardText = answering("RewardText", lambda obs, reward, *others: (obs, str(reward), *others))
TerminatedNone = answering("TerminatedNone", lambda obs, reward, ended, *others: (obs, reward, None, *others))
TruncatedText = answering("TruncatedText", lambda obs, reward, ended, cut, info: (obs, reward, ended, "no", info))
TerminatedInfo = answering("TerminatedInfo", lambda obs, reward, ended, cut, info: (obs, reward, cut, info, {}))
Zeros = answering("Zeros", lambda obs, reward, ended, cut, info: (obs, reward, int(ended), np.float32(cut), info))
NoInfo = answering("NoInfo", lambda *result: (*result[:4], None))


class OnlyObservation(Good):
    def reset(self, **kwargs):
        return super().reset(**kwargs)[0]


class TwoKeysOnly(MissingKey):
    """Returns a dict with two keys, which can be unpacked like a pair."""

    late = False

    def reset(self, **kwargs):
        return super().reset(**kwargs)[0]


class NoSeed(Good):
    def reset(self):
        return super().reset()


class FewSeeds(Good):
    def reset(self, *, seed=None, options=None):
        if seed is not None and not 100 <= seed < 110:
            raise ValueError("there are ten levels")
        return super().reset(seed=seed)


class Unrepeatable(Good):
    def reset(self, *, seed=None, options=None):
        return super().reset(options=options)


class FoldedLimit(Good):
    """Reports its time limit as a termination."""

    _max_episode_steps = 10

    def step(self, action):
        obs, reward, _, truncated, info = super().step(action)
        return obs, reward, truncated, False, info


class FoldedInInfo(Good):
    def step(self, action):
        obs, reward, _, truncated, _ = super().step(action)
        return obs, reward, truncated, False, {"TimeLimit.truncated": truncated}


class Endless(Good):
    observation_space = spaces.Box(-np.inf, np.inf, (3,), np.float32)

    def step(self, action):
        obs, reward, _, _, info = super().step(action)
        return obs, reward, False, False, info


class SameArray(Good):
    """Writes every observation into the same array."""

    def observe(self):
        self.__dict__.setdefault("array", np.zeros(3, np.float32))[:] = super().observe()
        return self.array


class Line(Reach):
    """A valid goal environment."""

    def _observe(self):
        return {key: np.array(value) for key, value in super()._observe().items()}


class OddReward(Line):
    def step(self, action):
        obs, reward, terminated, truncated, info = super().step(action)
        return obs, reward - 1.0 * (self.time > 3), terminated, truncated, info


class RewardNeedsInfo(Line):
    def compute_reward(self, achieved, desired, info):
        return super().compute_reward(achieved, desired, info) + 0.0 * info.get("scale", np.nan)

    def step(self, action):
        obs, _, terminated, truncated, info = super().step(action)
        info["scale"] = 1.0
        return obs, self.compute_reward(self.position, self.goal, info), terminated, truncated, info


class RewardReadsInfo(Line):
    def compute_reward(self, achieved, desired, info):
        return super().compute_reward(achieved, desired, info) * info["scale"]

    def step(self, action):
        self.position, self.time = self.position + action, self.time + 1
        info = {"scale": 2.0}
        return self._observe(), self.compute_reward(self.position, self.goal, info), False, self.time == 10, info


class MeanReward(Line):
    """Returns the mean reward for every goal of a batch."""

    def compute_reward(self, achieved, desired, info):
        reward = super().compute_reward(achieved, desired, info)
        return reward if reward.ndim == 0 else np.full_like(reward, reward.mean())


class RowReward(Line):
    """Accepts one goal at a time."""

    def compute_reward(self, achieved, desired, info):
        return -float(np.linalg.norm(achieved - desired) >= 0.5)


class RewardWithAxis(Line):
    """Returns an array for a single goal."""

    def compute_reward(self, achieved, desired, info):
        return super().compute_reward(achieved, desired, info)[..., None]

    def step(self, action):
        self.position = self.position + action
        self.time += 1
        reward = self.compute_reward(self.position, self.goal, {})[0]
        return self._observe(), float(reward), False, self.time == 10, {}


class RewardReadsPosition(Line):
    """The achieved goal of a relabeled step is not where the environment is."""

    def compute_reward(self, achieved, desired, info):
        return super().compute_reward(self.position, desired, info)


class RewardReadsGoal(Line):
    def compute_reward(self, achieved, desired, info):
        return -np.abs(achieved - self.goal)[..., 0]

    def step(self, action):
        obs, _, *flags, info = super().step(action)
        return obs, float(self.compute_reward(self.position, self.goal, {})), *flags, info


class RewardCounts(Line):
    def compute_reward(self, achieved, desired, info):
        self.calls = getattr(self, "calls", 0) + 1
        return super().compute_reward(achieved, desired, info) - 0.01 * self.calls


class RewardInPlace(Line):
    def step(self, action):
        position = self.position + action
        result = super().step(action)
        self.position = position
        return self._observe(), *result[1:]

    def compute_reward(self, achieved, desired, info):
        achieved -= desired
        return super().compute_reward(achieved, 0.0, info)


class SameReward(Line):
    """Has a tolerance that no goal passes."""

    def compute_reward(self, achieved, desired, info):
        return np.zeros(np.shape(achieved)[:-1], np.float32) - 1.0


class RewardOfNothing(Line):
    """Divides by the distance where ``step`` does not."""

    def compute_reward(self, achieved, desired, info):
        return np.where(achieved == desired, np.nan, super().compute_reward(achieved, desired, info)[..., None])[..., 0]


class RewardsAsText(Line):
    def compute_reward(self, achieved, desired, info):
        reward = super().compute_reward(achieved, desired, info)
        return reward.astype(str) if np.ndim(reward) else reward


class EndsAtGoal(Line):
    def __init__(self):
        super().__init__(stops=True)


class TerminatedReadsPosition(EndsAtGoal):
    def compute_terminated(self, achieved, desired, info):
        return (np.abs(self.position - desired) < 0.5)[..., 0]


class TerminatedAsReward(Line):
    def compute_terminated(self, achieved, desired, info):
        return self.compute_reward(achieved, desired, info)


class SuccessAsText(Line):
    success: Any = "yes"

    def step(self, action):
        return *super().step(action)[:4], {"is_success": self.success}


class SuccessOfParts(SuccessAsText):
    success = np.array([True, False])


class OddTerminated(Line):
    def compute_terminated(self, achieved, desired, info):
        return np.ones(np.shape(achieved)[:-1], bool)


class Fault(NamedTuple):
    """The expected messages of an environment."""

    make: Any
    level: str
    checked: str
    trained: str | None
    """Message of the error that ends training; None if training continues."""


EVERY: dict[str, Fault] = {
    "float as image": Fault(
        FloatAsImage,
        "error",
        "dtype float64, expected uint8, which cannot hold 0.5 at index .*multiply by 255",
        "the observation of dtype float64, expected uint8, which cannot hold 0.5",
    ),
    "double": Fault(Double, "error", r"the observation of dtype float64, expected float32; .*astype", None),
    "list": Fault(AsList, "error", "the observation .*expected", None),
    "scalar": Fault(Scalar, "error", r"of shape \(\), expected \(3,\)", r"step 3: .* of shape \(\), expected \(3,\)"),
    "too long": Fault(TooLong, "error", r"of shape \(4,\), expected \(3,\)", r"step 3: .* of shape \(4,\), expected"),
    "nested shape": Fault(
        NestedShape, "error", r"'arm.angles' of shape \(3,\), expected \(2,\)", r"'arm.angles' of shape \(3,\), exp"
    ),
    "tuple shape": Fault(
        TupleShape, "error", r"under '1' of shape \(2,\), expected \(\)", r"under '1' of shape \(2,\), expected \(\)"
    ),
    "missing key": Fault(
        MissingKey, "error", "expected left, right; add right", "keys left, expected left, right; add"
    ),
    "nothing seen": Fault(NothingSeen, "error", "observation as None", "step 3: .*the observation as None"),
    "nan seen": Fault(NanSeen, "error", "the observation with nan at index 1", r"an observation with nan at \[1\]"),
    "out of bounds": Fault(
        OutOfBounds, "warning", r"under 'speed' with 7.5 at index 1, outside of the declared bounds \[-1.0, 1.0\]", None
    ),
    "four values": Fault(
        FourValues, "error", "4 values as in the old package gym", "4 values .* expected .*terminated, truncated"
    ),
    "no reward": Fault(NoReward, "error", "the reward None", "the reward None, expected one finite number"),
    "nan reward": Fault(NanReward, "error", "the reward nan, expected one finite", "returned the reward nan in env"),
    "huge reward": Fault(
        HugeReward, "error", r"the reward 1e\+300, beyond 3.4e\+38", r"the reward 1e\+300, beyond 3.4e\+38"
    ),
    "endless reward": Fault(
        EndlessReward, "error", r"the reward 10000\d+, beyond", r"the reward 10000\d+, beyond 3.4e\+38"
    ),
    "no info": Fault(NoInfo, "error", "the info None, expected a dict", "step 3: .*the info None, expected a dict"),
    "reward array": Fault(RewardArray, "error", r"a reward of shape \(2,\)", r"a reward of shape \(2,\).*sum or av"),
    "reward of one": Fault(RewardOfOne, "error", r"a reward of shape \(1,\).*float\(reward\[0\]\)", None),
    "reward text": Fault(RewardText, "error", "the reward '.*' of type str", "the reward '.*' of type str, expected"),
    "terminated None": Fault(TerminatedNone, "error", "terminated=None of type None", "terminated=None .* a bool"),
    "truncated text": Fault(TruncatedText, "error", "truncated='no' of type str", "truncated='no' .*expected a bool"),
    "terminated info": Fault(
        TerminatedInfo, "error", "truncated={} .*is the info", "truncated={} .*is the info in its"
    ),
    "zeros": Fault(Zeros, "error", "terminated=0 of type int, expected a bool", None),
    "only observation": Fault(
        OnlyObservation, "error", "reset returned the observation only", "the observation only, expected .obs, info"
    ),
    "two keys only": Fault(TwoKeysOnly, "error", "the observation only", "the observation only, expected .obs, info"),
    "no seed": Fault(NoSeed, "error", r"NoSeed.reset\(\) takes no seed", r"NoSeed.reset\(\) takes no seed, expected"),
    "few seeds": Fault(
        FewSeeds,
        "error",
        r"reset\(seed=2147483646\) raised ValueError: there are ten levels, .* give one seed for each",
        r"FewSeeds, environment 0, the first reset: reset\(seed=\d+\) raised ValueError: there are ten levels, and .*seed=",
    ),
    "unrepeatable": Fault(
        Unrepeatable, "warning", r"env_checker: .*does not call `super\(\).reset\(seed=seed\)`", None
    ),
    "folded limit": Fault(FoldedLimit, "warning", "terminated at its time limit of 10 steps.*truncated=True", None),
    "folded in info": Fault(FoldedInInfo, "error", "'TimeLimit.truncated'.* truncated=False", None),
    "endless": Fault(Endless, "warning", r"no episode ended in .* steps; .*max_episode_steps", None),
    "odd reward": Fault(OddReward, "error", "step gave the reward .* compute_reward .* they must agree", None),
    "reward needs info": Fault(RewardNeedsInfo, "error", "with an empty info", None),
    "reward reads info": Fault(
        RewardReadsInfo, "error", "raised KeyError: 'scale' with an empty info; let it depend on .*copy_info_dict", None
    ),
    "mean reward": Fault(MeanReward, "error", "of many goals at once .* of the same goals one by one", None),
    "row reward": Fault(RowReward, "warning", r"compute_reward .*\(.*rejeu then calls it row by row", None),
    "reward with axis": Fault(RewardWithAxis, "warning", r"compute_reward .*\(.*rejeu then calls it row by row", None),
    "reward reads position": Fault(
        RewardReadsPosition,
        "error",
        "compute_reward of the same two goals gave -?0.0 after one step and -1.0 later",
        None,
    ),
    "reward reads goal": Fault(RewardReadsGoal, "error", "same two goals gave .* it reads something else", None),
    "reward counts": Fault(RewardCounts, "error", "same two goals gave .* it reads something else", None),
    "reward in place": Fault(RewardInPlace, "error", "compute_reward changes its arguments in place", None),
    "same reward": Fault(SameReward, "warning", r"gave -1.0 for each of \d+ pairs of goals, also of equal ones", None),
    "reward of nothing": Fault(
        RewardOfNothing, "error", "compute_reward of goals of other steps returned the reward nan, expected", None
    ),
    "rewards as text": Fault(RewardsAsText, "warning", r"dtype <U32, expected numbers \(\d+,\)", None),
    "ends at goal": Fault(EndsAtGoal, "warning", "terminated at its goal, and there is no compute_terminated", None),
    "terminated reads position": Fault(
        TerminatedReadsPosition, "error", "compute_terminated of the same two goals gave True after one step", None
    ),
    "terminated as reward": Fault(TerminatedAsReward, "error", "of one goal returned terminated=.*-1.0.*a bool", None),
    "success as text": Fault(SuccessAsText, "warning", "'is_success': 'yes'}, expected one bool", None),
    "success of parts": Fault(SuccessOfParts, "warning", r"'is_success': array\(.*, expected one bool", None),
    "odd terminated": Fault(OddTerminated, "error", "compute_terminated .* True .* step .*terminated=False", None),
}
if tuple(map(int, gym.__version__.split(".")[:2])) >= (1, 4):  # whose checker looks for it
    EVERY["same array"] = Fault(SameArray, "warning", "env_checker: .*share an object", None)
