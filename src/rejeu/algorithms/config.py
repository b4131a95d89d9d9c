"""The hyperparameters of every algorithm and of off-policy algorithms, and configurations as JSON.

A configuration is a frozen, hashable dataclass. Each field has an attribute docstring, from which ``help()``, the command
line and the documentation are generated. Values are given in the form of Stable-Baselines3 and converted when the
configuration is created.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from types import UnionType
from typing import Any, ClassVar, Literal, Union, get_args, get_origin, get_type_hints

import optax
from gymnasium import spaces

from rejeu.algorithms import optimizers, search
from rejeu.algorithms.search import SearchSpace
from rejeu.core import normalization, schedules
from rejeu.core.errors import MissingObjectError
from rejeu.core.normalization import NormalizationConfig
from rejeu.core.schedules import Schedule
from rejeu.core.spaces import Leaf, leaves
from rejeu.core.types import JsonObject, PyTree, Settings
from rejeu.core.validation import C, assign, build, choice, coerce, flag, nested, number, whole
from rejeu.exploration import noise as action_noises
from rejeu.exploration.parameter_space import ParameterNoise
from rejeu.networks import ENCODERS, MemoryConfig, PolicyConfig, Widths, reads_image, settled
from rejeu.replay.hindsight import ANY_STEP, STRATEGIES, HerReplayBuffer, HindsightConfig, MixedStrategies
from rejeu.replay.prioritized import PriorityConfig

REPLAY_BUFFERS = {"ReplayBuffer": None, "HerReplayBuffer": HindsightConfig}
"""The replay buffers by name, and the configuration of each."""
MOST_ROWS = 10**12
"""Upper limit on the size of a replay buffer and of its batches, beyond the memory of any machine. What fits is checked when
a run begins, since it may be another machine than the one on which a plan is read."""
OWN = "own"
"""Key of the name by which a file mentions an object of the user's own."""
registered: dict[str, Any] = {}
"""The configurations of algorithms that are not rejeu's, by name; :func:`rejeu.register` adds to it."""
OWN_MODULES = ("encoder", "torso", "head")
"""Settings of ``policy_kwargs`` that are modules of the user's own."""
NAMED: Mapping[str, Mapping[str, Callable[..., Any]]] = {"encoder": ENCODERS, "goal_selection_strategy": STRATEGIES}
"""Settings that a registered name may stand for, and what is registered."""


@dataclass(frozen=True)
class RndConfig:
    """Settings of random network distillation; see :mod:`rejeu.algorithms.rnd`."""

    coefficient: float = 1.0
    """Weight of the bonus, whose standard deviation is 1, in the unit of rewards. A larger value explores more."""
    learning_rate: float = 1e-4
    """Step size of the predictor. A larger value makes the bonus of an observation vanish faster."""
    n_features: int = 64
    """Outputs that are predicted."""
    batch_size: int = 256
    """Observations per gradient step of the predictor, if a batch or a rollout has more."""

    def __post_init__(self) -> None:
        coerce(self, "coefficient", number, above=0)
        coerce(self, "learning_rate", number, least=0)
        coerce(self, ("n_features", "batch_size"), whole, least=1)

    @classmethod
    def parse(cls, key: str, value: object) -> RndConfig | None:
        """Returns the settings that a weight, a dict or None stands for; None for the weight 0."""
        if isinstance(value, int | float) and not isinstance(value, bool):
            value = {"coefficient": value} if value else None
        return None if value is None else nested(key, value, cls)


@dataclass(frozen=True, kw_only=True)
class AlgorithmConfig:
    """The hyperparameters of every algorithm. Abstract."""

    learning_rate: float | Schedule = 3e-4
    """Step size of every optimizer: a number, ``rejeu.Linear(start, end)``, ``rejeu.Exponential(start, end)``,
    ``"lin_3e-4"`` or a function of the progress from 0 to 1. A larger value learns faster until it diverges."""
    gamma: float = 0.99
    """Discount factor, in [0, 1]."""
    max_grad_norm: float | None = None
    """Maximum Euclidean norm of each optimizer's gradient; larger gradients are scaled down. None: no limit."""
    normalize: NormalizationConfig | None = None
    """Normalize observations and rewards by running statistics: True, or a dict with ``norm_obs``, ``norm_reward``,
    ``clip_obs``, ``clip_reward``. The statistics are saved with the agent, which takes raw observations."""
    nonfinite: Literal["stop", "skip"] = "stop"
    """Reaction to an update that results in a loss or a weight that is NaN or infinite: ``"stop"`` with an error that names
    it and saves what was learned from, or ``"skip"`` that update and count it."""
    action_masks: bool = False
    """Take masks of the allowed actions from the environment (``info["action_mask"]`` or ``action_masks()``) and choose
    among these only. For Discrete actions; PPO, A2C, TRPO and RecurrentPPO take MultiDiscrete and MultiBinary too."""
    action_share: float = 1.0
    """Share of the range of each action that the policy uses, around its middle, in (0, 1]. A smaller one keeps strong motors
    from throwing a robot over. For Box actions."""
    action_repeat: int = 1
    """Environment steps for which each action is held. Training then counts such decisions as steps; a reward is the sum over
    them, or with hindsight that of the last one. Larger values make episodes shorter and exploration go farther."""
    rnd: RndConfig | None = None
    """Adds a bonus for new observations to the rewards that are learned from (random network distillation, arXiv
    1810.12894): its weight such as 0.5, or a dict with ``coefficient``, ``learning_rate``, ``n_features``, ``batch_size``."""
    optimizer: Any = "adam"
    """``"adam"``, ``"adamw"``, ``"nadam"``, ``"radam"``, ``"amsgrad"``, ``"lion"``, ``"rmsprop"``, ``"sgd"``, a dict of
    such a name and settings (``{"name": "adamw", "weight_decay": 0.01}``), an Optax optimizer such as ``optax.lamb``, or
    one that was created with the learning rate 1, which is then ``learning_rate``."""
    policy_kwargs: PolicyConfig = dataclasses.field(default_factory=PolicyConfig)
    """Shape of the networks: ``net_arch``, ``activation_fn``, ``layer_norm``, ``architecture``, branches
    (``state_layers``, ``action_layers``, ``common_layers``, ``critic_layers``, ``actor_layers``), or modules of your own
    as ``encoder``, ``torso`` and ``head``."""

    name: ClassVar[str] = ""
    can_mask: ClassVar[bool] = False
    """Whether the algorithm can take masks of the allowed actions."""
    can_drop: ClassVar[bool] = False
    """Whether the critics can learn with dropout."""
    is_checked: ClassVar[bool] = False
    """Whether :meth:`__post_init__` has run; set on each instance."""
    policy_kwargs_class: ClassVar[type[PolicyConfig]] = PolicyConfig
    """The class of ``policy_kwargs``."""
    hidden_layers: ClassVar[Widths] = Widths((256, 256), (256, 256))
    """Default widths of the networks."""
    hidden_layers_on_images: ClassVar[Widths] = hidden_layers
    """Default widths where the observation is an image."""
    for_many: ClassVar[Mapping[str, object]] = {}
    """Hyperparameters that ``rejeu train`` uses with 64 environments or more, without a preset."""
    search_space: ClassVar[SearchSpace] = {}
    """Where ``rejeu tune`` searches, by the name of the hyperparameter."""

    def __post_init__(self) -> None:
        coerce(self, "learning_rate", schedules.parse, least=0)
        coerce(self, "optimizer", optimizers.parse, optional=type(self).optimizer is None)
        coerce(self, "gamma", number, least=0, most=1)
        coerce(self, "max_grad_norm", number, above=0, optional=True)
        coerce(self, "normalize", normalization.parse, optional=True)
        coerce(self, "nonfinite", choice, among=("stop", "skip"))
        coerce(self, "policy_kwargs", nested, config_class=self.policy_kwargs_class)
        coerce(self, "rnd", RndConfig.parse)
        coerce(self, "action_masks", flag)
        coerce(self, "action_share", number, above=0, most=1)
        coerce(self, "action_repeat", whole, least=1)
        if self.action_masks:
            self._check_masks()
        if self.policy_kwargs.dropout and not self.can_drop:
            raise ValueError(f"policy_kwargs: {self.name} has no critics with dropout; leave it out, or use SAC or TQC")
        assign(self, is_checked=True)

    def _check_masks(self) -> None:
        """Raises ``ValueError`` if the algorithm cannot take masks, or not with these settings."""
        if not self.can_mask:
            raise ValueError(
                f"action_masks=True: {self.name} takes no masks; use PPO, A2C, TRPO, RecurrentPPO, DQN, QRDQN, IQN or SAC"
            )
        if self.action_repeat > 1:
            raise ValueError(
                f"action_repeat={self.action_repeat} holds an action that later masks may forbid; leave it or action_masks out"
            )

    def doubts(self, n_envs: int) -> str:
        """Returns why these settings are unlikely to learn well with ``n_envs`` environments; empty if that is not known."""
        return ""


@dataclass(frozen=True, kw_only=True)
class OffPolicyConfig(AlgorithmConfig):
    """The hyperparameters of every algorithm with a replay buffer."""

    buffer_size: int = 1_000_000
    """Maximum number of steps in the replay buffer, over all environments. The oldest are overwritten. Memory is
    proportional to it."""
    learning_starts: int = 100
    """Environment steps with uniformly random actions before learning starts."""
    batch_size: int = 256
    """Transitions per gradient step, drawn with replacement. Larger batches reduce the variance of the gradient at a higher
    cost."""
    tau: float = 0.005
    """Coefficient of the soft update of the target network (Polyak averaging), in [0, 1]; 0 never moves it."""
    train_freq: int | tuple[int, Literal["step", "episode"]] = 1
    """Update every ``train_freq`` environment steps, or ``(n, "episode")``: every n finished episodes. Counted over all
    environments together."""
    gradient_steps: int = 1
    """Gradient steps per update; 0 takes none, which only collects experience; -1 takes as many as there were environment
    steps since the last update."""
    action_noise: Any = None
    """Noise added to the actions of the training policy: a standard deviation for actions in [-1, 1] such as 0.1,
    ``"ou(0.2)"``, an object such as ``NormalActionNoise(mean, sigma)``, or one of your own. None for no noise."""
    replay_buffer_class: str | type = "ReplayBuffer"
    """``HerReplayBuffer`` relabels goals in hindsight and needs a goal environment; ``ReplayBuffer`` or None does not.
    Or a class of your own with the constructor and methods of one of them, such as a subclass; see ``rejeu.replay``."""
    replay_buffer_kwargs: HindsightConfig | tuple[tuple[str, object], ...] | None = None
    """Settings of the replay buffer: ``n_sampled_goal`` and ``goal_selection_strategy`` for ``HerReplayBuffer``;
    further keyword arguments for a class of your own."""
    n_steps: int = 1
    """Number of rewards summed before bootstrapping (n-step returns). Larger values propagate rewards faster, with some
    off-policy bias."""
    priorities: PriorityConfig | None = None
    """Prioritized experience replay: ``dict(alpha=0.6, beta=0.4)``, or ``{}`` for the defaults. None samples uniformly."""
    demonstrations: str | None = None
    """Folder of a Minari dataset, such as ``rejeu play --record`` writes, a share of which is in every batch. Observations and
    actions must be those of the environment. None for none."""
    demonstration_share: float = 0.5
    """Share of each batch that is drawn from ``demonstrations``, in [0, 1]. A larger share stays closer to them."""
    offline: bool = False
    """Learn from ``demonstrations`` alone, without stepping an environment: each step of training is a gradient step."""
    frame_stack: int | None = None
    """Number of frames that observations stack along the first axis. The replay buffer then stores each frame once and
    builds the stacks when it samples. None stores observations as they are."""
    overlap: bool = True
    """Step the environments while the update is computed: an action then uses the weights of the update before the last, in
    a fixed order, so that runs are reproducible. False waits for the newest weights before every action and is slower."""
    policy_kwargs: MemoryConfig = dataclasses.field(default_factory=MemoryConfig)
    """Shape of the networks: ``net_arch``, ``activation_fn``, ``layer_norm``, ``architecture``, branches
    (``state_layers``, ``action_layers``, ``common_layers``, ``critic_layers``, ``actor_layers``), a memory
    (``lstm_hidden_size``, ``cell``, ``sequence_length``, ``burn_in``), or modules of your own as ``encoder``, ``torso`` and
    ``head``."""

    can_remember: ClassVar[bool] = False
    """Whether the networks may have a memory."""
    needs_next_action: ClassVar[bool] = False
    """Whether batches have :attr:`rejeu.Transition.next_action`."""
    policy_kwargs_class: ClassVar[type[PolicyConfig]] = MemoryConfig
    search_space: ClassVar[SearchSpace] = search.OFF_POLICY

    def __post_init__(self) -> None:
        AlgorithmConfig.__post_init__(self)
        coerce(self, ("buffer_size", "batch_size", "n_steps"), whole, least=1, most=MOST_ROWS)
        coerce(self, "frame_stack", whole, least=1, optional=True)
        coerce(self, "learning_starts", whole, least=0)
        coerce(self, "tau", number, least=0, most=1)
        coerce(self, "train_freq", train_freq)
        coerce(self, "gradient_steps", whole, least=-1)
        coerce(self, "overlap", flag)
        coerce(self, "priorities", nested, config_class=PriorityConfig, optional=True)
        coerce(self, "demonstration_share", number, least=0, most=1)
        coerce(self, "offline", flag)
        if self.demonstrations is not None:
            self._check_demonstrations()
        if self.offline and self.demonstrations is None:
            raise ValueError("offline=True learns from demonstrations alone; give demonstrations=FOLDER too")
        if self.action_noise is not None:
            assign(self, action_noise=action_noises.parse(self.action_noise))
        coerce(self, "replay_buffer_class", buffer_name)
        coerce(self, "replay_buffer_kwargs", buffer_settings, buffer=self.replay_buffer_class)
        if self.has_memory:
            self._check_memory()

    def _check_demonstrations(self) -> None:
        """Makes the folder absolute, because a run may be resumed from another one.

        Raises:
            TypeError, ValueError: if it is no path, or with these settings nothing can be learned from it.
        """
        if not isinstance(self.demonstrations, str | Path):
            raise TypeError(f"demonstrations={self.demonstrations!r} must be the folder of record(..., path=FOLDER)")
        assign(self, demonstrations=str(Path(self.demonstrations).absolute()))
        if self.priorities is not None:
            raise ValueError("demonstrations are drawn uniformly and cannot be combined with priorities; leave one out")
        if self.action_repeat > 1:
            raise ValueError(f"demonstrations are single steps, not {self.action_repeat}; leave action_repeat out")

    def _check_memory(self) -> None:
        """Raises ``ValueError`` if the networks cannot have a memory, or with these settings cannot learn with it."""
        if not self.can_remember:
            raise ValueError(
                f"policy_kwargs: {self.name} has no networks with memory; leave lstm_hidden_size out, or use SAC, TQC, TD3, "
                "DQN or RecurrentPPO"
            )
        refused = {
            f"replay_buffer_class={self.replay_buffer_class!r}": self.replay_buffer_class != "ReplayBuffer",
            "priorities": self.priorities is not None,
            "demonstrations": self.demonstrations is not None,
            "action_noise=ParameterNoise()": isinstance(self.action_noise, ParameterNoise),
        }
        if refusal := [setting for setting, is_given in refused.items() if is_given]:
            raise ValueError(
                f"{refusal[0]} is not available for networks with memory, which learn from whole sequences; leave it out, or "
                "lstm_hidden_size"
            )
        length = self.policy_kwargs.sequence_length
        if self.batch_size % length:
            below = max(self.batch_size // length, 1) * length
            raise ValueError(
                f"batch_size={self.batch_size} must be divisible by sequence_length={length}, the steps that are learned "
                f"from together; try {below}"
            )

    @property
    def has_memory(self) -> bool:
        """Whether the networks have a memory."""
        return self.policy_kwargs.lstm_hidden_size is not None

    @property
    def hindsight(self) -> HindsightConfig | None:
        """How goals are relabeled, or None where they are not."""
        settings = self.replay_buffer_kwargs
        return settings if isinstance(settings, HindsightConfig) else None


def rebuild(config_class: type[C], saved: Mapping[str, object], changes: Mapping[str, object]) -> C:
    """Returns the configuration of a file with some settings changed; of ``policy_kwargs`` only the given ones.

    Raises:
        MissingObjectError: if the file names an object of the user's own, such as a ``torso``, and none is given.
    """
    merged = {**saved, **changes}
    policy, old = changes.get("policy_kwargs"), saved.get("policy_kwargs")
    if isinstance(policy, Mapping) and isinstance(old, Mapping):
        replaced = ("pi", "qf", "vf") if "net_arch" in policy else ()
        merged["policy_kwargs"] = {key: value for key, value in old.items() if key not in replaced} | dict(policy)
    for keys, name in own_names(merged):
        argument = f"{keys[-1]}={name}"
        for key in keys[-2::-1]:
            argument = f"{key}=dict({argument})"
        raise MissingObjectError(
            f"its {keys[-1]} is your own, {name!r}, and no file holds code; give it again: load(path, {argument})"
            + (", or import the module that registers it (--import MODULE)" if keys[-1] in NAMED else "")
        )
    return build(config_class, merged)


def own_names(saved: Mapping[str, object]) -> Iterator[tuple[tuple[str, ...], str]]:
    """Yields the path and the name of each object of the user's own that the configuration of a file mentions."""
    for key, value in saved.items():
        if isinstance(value, Mapping) and set(value) == {OWN}:
            yield (key,), str(value[OWN])[:40]
        elif key in NAMED and isinstance(value, str | Mapping):
            names = [value] if isinstance(value, str) else value
            yield from (((key,), name[:40]) for name in names if name not in (*ANY_STEP, *NAMED[key]))
        elif isinstance(value, Mapping):
            yield from (((key, *keys), name) for keys, name in own_names(value))


def own_changes(saved: Mapping[str, object], changes: Mapping[str, object]) -> Settings:
    """Returns of changed settings only those that replace objects of the user's own, which a file cannot do without."""
    mentioned = {keys[0] for keys, _ in own_names(saved)} - {"policy_kwargs"}
    policy = changes.get("policy_kwargs")
    modules = {key: policy[key] for key in OWN_MODULES if key in policy} if isinstance(policy, Mapping) else {}
    replacements = {key: value for key, value in changes.items() if key in mentioned}
    return replacements | ({"policy_kwargs": modules} if modules else {})


@cache
def value_types(config_class: Any) -> dict[str, tuple[Any, ...]]:
    """Returns the types that the values of each field of a configuration may have, such as ``(float, Schedule)``."""
    hints = get_type_hints(config_class)
    return {name: get_args(x) if get_origin(x) in (Union, UnionType) else (x,) for name, x in hints.items()}


def takes_schedule(config_class: type, name: str) -> bool:
    """Returns whether a hyperparameter may be a function of the progress."""
    return Schedule in value_types(config_class).get(name, ())


def is_own(value: object) -> bool:
    """Returns whether a setting is code of the user's own, which a file can only mention."""
    return callable(value) or isinstance(value, optax.GradientTransformation | action_noises.NoiseProcess)


def with_widths(config: C, obs_leaves: tuple[Leaf, ...]) -> C:
    """Returns a configuration whose ``policy_kwargs`` give the widths of hidden layers that were left to the default.

    These depend on the observation, whose leaves are given.
    """
    config_class: type[PyTree] = type(config)
    shape = config.policy_kwargs  # type: ignore[attr-defined]
    widths = config_class.hidden_layers_on_images if reads_image(obs_leaves, shape) else config_class.hidden_layers
    missing = settled(vars(shape), widths)
    return dataclasses.replace(config, policy_kwargs=dataclasses.replace(shape, **missing)) if missing else config  # type: ignore


def network_inputs(config: Any, observation_space: spaces.Space) -> tuple[tuple[Leaf, ...], Any]:
    """Returns the arguments of networks: the leaves of observations, and the ``policy_kwargs`` with their widths.

    Raises:
        TypeError: if the observation space holds something that is not an array.
    """
    obs_leaves = leaves(observation_space)
    return obs_leaves, with_widths(config, obs_leaves).policy_kwargs


def to_json(config: Any) -> JsonObject:
    """Returns a configuration as plain JSON values, from which :func:`build` makes it again.

    Objects of the user's own, such as a ``torso``, are only mentioned, and must be given again (:func:`rebuild`).
    """
    return {field.name: value_to_json(getattr(config, field.name)) for field in dataclasses.fields(config)}


def value_to_json(value: object) -> Any:
    """Returns the JSON form of the value of a setting."""
    if isinstance(value, schedules.Live):
        return value.value
    if type(value) in schedules.SCHEDULES.values():
        return schedules.to_json(value)
    if type(value) in action_noises.NOISES.values():
        return action_noises.to_json(value)
    if isinstance(value, optimizers.Named):
        return {"name": value.name, **dict(value.settings)}
    if isinstance(value, MixedStrategies):
        return dict(value.shares)
    if is_own(value):
        return {OWN: optimizers.name(value)}
    if dataclasses.is_dataclass(value):
        return to_json(value)
    return list(value) if isinstance(value, tuple) else value


def buffer_name(key: str, value: object) -> str | type:
    """Returns the name of a replay buffer from its name, its class or None, or a class of the user's own."""
    if value is None:
        return "ReplayBuffer"
    if isinstance(value, type) and value.__name__ not in REPLAY_BUFFERS:
        return value
    return choice(key, value if isinstance(value, str) else getattr(value, "__name__", repr(value)), REPLAY_BUFFERS)


def buffer_settings(key: str, value: Any, buffer: str | type) -> Any:
    """Returns the settings of a replay buffer: a record or, for a class of the user's own, pairs of names and values."""
    if isinstance(buffer, type) and not issubclass(buffer, HerReplayBuffer):
        settings = dict(value or {}).items()
        return tuple((name, tuple(entry) if isinstance(entry, list) else entry) for name, entry in settings)
    settings_class = HindsightConfig if isinstance(buffer, type) else REPLAY_BUFFERS[buffer]
    if settings_class is not None:
        return nested(key, value or {}, settings_class)
    if value:
        raise ValueError(
            f"{key}={value!r} does not apply to {buffer}; did you forget replay_buffer_class=HerReplayBuffer?"
        )
    return None


def train_freq(key: str, value: object) -> int | tuple[int, Literal["step", "episode"]]:
    """Returns a frequency in steps, or ``(n, "episode")``."""
    if isinstance(value, tuple | list) and len(value) == 2 and value[1] in ("step", "episode"):
        count = whole(key, value[0], least=1)
        return count if value[1] == "step" else (count, "episode")
    if isinstance(value, int | float):
        return whole(key, value, least=1)
    raise ValueError(f"{key}={value!r} must be a whole number of steps, or (n, 'step') or (n, 'episode')")
