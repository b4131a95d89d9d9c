"""How hyper-parameters are declared, checked, documented and saved.

A configuration is a frozen dataclass whose every field carries an attribute docstring; the command line, ``help()`` and
the documentation are made from it. It accepts what Stable-Baselines3 users write, keeps it in one hashable form, and
turns into JSON and back.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, ClassVar, Literal

from rejeu import normalization, schedules
from rejeu.buffers.hindsight import HindsightConfig
from rejeu.buffers.prioritized import PriorityConfig
from rejeu.errors import CheckpointError
from rejeu.exploration import noise as action_noises
from rejeu.loops import finite
from rejeu.networks import PolicyConfig, Widths, reads_image, settled
from rejeu.normalization import NormalizationConfig
from rejeu.schedules import Schedule
from rejeu.spaces import Leaf
from rejeu.validation import C, build, nested, number, whole

REPLAY_BUFFERS = {"ReplayBuffer": None, "HerReplayBuffer": HindsightConfig}
"""Names for ``replay_buffer_class`` and what configures each."""


@dataclass(frozen=True, kw_only=True)
class OffPolicyConfig:
    """What every algorithm that learns from replayed experience can be told."""

    learning_rate: float | Schedule = 3e-4
    """Step size of Adam for every network; a number, ``rejeu.Linear(start, end)``, ``rejeu.Exponential(start, end)`` or
    ``"lin_3e-4"``. Raising it learns faster until it diverges."""
    buffer_size: int = 1_000_000
    """Most steps that the replay buffer keeps, over all environments; the oldest make room. Raising it remembers longer
    and takes memory in proportion."""
    learning_starts: int = 100
    """Environment steps of uniformly random actions before learning begins."""
    batch_size: int = 256
    """Transitions per gradient step. Raising it gives a steadier, dearer step."""
    tau: float = 0.005
    """Share of the online network that flows into the target network at each gradient step, in (0, 1]."""
    gamma: float = 0.99
    """Discount factor, in [0, 1]. Raising it looks further ahead."""
    train_freq: int | tuple[int, Literal["step", "episode"]] = 1
    """Learn every so many environment steps, or ``(n, "episode")``: every n finished episodes. Counted over all
    environments together, whatever their number."""
    gradient_steps: int = 1
    """Gradient steps each time; -1 means as many as environment steps were taken since the last time."""
    action_noise: action_noises.Noise | float | str | None = None
    """Noise added to the actions of the training policy: a standard deviation for actions in [-1, 1] such as 0.1,
    ``"ou(0.2)"``, or an object such as ``NormalActionNoise(mean, sigma)``. None for none."""
    replay_buffer_class: str = "ReplayBuffer"
    """``HerReplayBuffer`` relabels goals in hindsight and needs a goal environment; ``ReplayBuffer`` or None does not."""
    replay_buffer_kwargs: HindsightConfig | None = None
    """Settings of the replay buffer: ``n_sampled_goal`` and ``goal_selection_strategy`` for ``HerReplayBuffer``."""
    n_steps: int = 1
    """Rewards summed before bootstrapping: n-step returns. Raising it spreads rewards faster, off-policy with some bias."""
    priorities: PriorityConfig | None = None
    """Draw steps by their TD error: ``dict(alpha=0.6, beta=0.4)`` or ``{}`` for the defaults. None draws uniformly."""
    frame_stack: int | None = None
    """Observations are stacks of this many frames along the first axis; only the newest is stored and stacks are built
    when sampled, so the replay buffer takes that many times less memory. None stores observations as they are."""
    normalize: NormalizationConfig | None = None
    """Scale observations and rewards by what has been seen: True, or a dict with ``norm_obs``, ``norm_reward``,
    ``clip_obs``, ``clip_reward``. The statistics are learnt and saved with the agent, which takes raw observations."""
    nonfinite: finite.Nonfinite = "stop"
    """What to do when an update leaves a loss or a weight that is NaN or infinite: ``"stop"`` with an error that names
    it and saves the batch, or ``"skip"`` that update as if its batch had never been drawn, and count it."""
    overlap: bool = True
    """Step the environments while the newest update is computed: an action then follows the update of the step before the
    last, in a fixed order, so that runs repeat exactly. False waits for the newest weights before every action; slower."""
    policy_kwargs: PolicyConfig = dataclasses.field(default_factory=PolicyConfig)
    """Shape of the networks: ``net_arch``, ``activation_fn``, ``layer_norm``, ``architecture``, branches
    (``state_layers``, ``action_layers``, ``common_layers``, ``critic_layers``, ``actor_layers``) or a ``torso`` of your
    own."""

    name: ClassVar[str] = ""
    hidden_layers: ClassVar[Widths] = Widths((256, 256), (256, 256))
    """Default widths of the networks."""
    hidden_layers_on_images: ClassVar[Widths] = hidden_layers
    """The same where the observation is an image."""

    def __post_init__(self) -> None:
        put = lambda key, value: object.__setattr__(self, key, value)  # noqa: E731
        put("learning_rate", schedules.parse("learning_rate", self.learning_rate))
        if min(schedules.at(self.learning_rate, 0.0), schedules.at(self.learning_rate, 1.0)) < 0:
            raise ValueError(f"learning_rate={self.learning_rate!r} must not fall below 0: the agent would unlearn")
        for key in ("buffer_size", "batch_size"):
            put(key, whole(key, getattr(self, key), least=1))
        put("learning_starts", whole("learning_starts", self.learning_starts, least=0))
        put("tau", number("tau", self.tau, above=0, most=1))
        put("gamma", number("gamma", self.gamma, least=0, most=1))
        put("train_freq", _train_freq(self.train_freq))
        put("gradient_steps", whole("gradient_steps", self.gradient_steps, least=-1))
        if self.gradient_steps == 0:
            raise ValueError(
                "gradient_steps=0 would never learn; use 1 or more, or -1 for as many as environment steps"
            )
        if self.batch_size > self.buffer_size:
            raise ValueError(
                f"batch_size={self.batch_size} must not exceed buffer_size={self.buffer_size}; "
                f"try buffer_size={max(10 * self.batch_size, 10_000)} or batch_size={self.buffer_size}"
            )
        put("action_noise", action_noises.parse(self.action_noise))
        put("n_steps", whole("n_steps", self.n_steps, least=1))
        if not isinstance(self.overlap, bool):
            raise ValueError(f"overlap={self.overlap!r} must be True or False")
        if self.priorities is not None:
            put("priorities", nested("priorities", PriorityConfig, self.priorities))
        if self.frame_stack is not None:
            put("frame_stack", whole("frame_stack", self.frame_stack, least=1))
        put("normalize", normalization.parse(self.normalize))
        put("nonfinite", finite.parse(self.nonfinite))
        put("policy_kwargs", nested("policy_kwargs", PolicyConfig, self.policy_kwargs))
        self._parse_replay()

    def _parse_replay(self) -> None:
        kind = self.replay_buffer_class
        key = (
            "ReplayBuffer" if kind is None else kind if isinstance(kind, str) else getattr(kind, "__name__", repr(kind))
        )
        if key not in REPLAY_BUFFERS:
            raise ValueError(f"replay_buffer_class={key!r} is unknown; choose one of {', '.join(REPLAY_BUFFERS)}")
        settings = REPLAY_BUFFERS[key]
        object.__setattr__(self, "replay_buffer_class", key)
        if settings is None:
            if self.replay_buffer_kwargs:
                raise ValueError(
                    f"replay_buffer_kwargs={self.replay_buffer_kwargs!r} has no meaning for {key}; "
                    "did you forget replay_buffer_class=HerReplayBuffer?"
                )
            object.__setattr__(self, "replay_buffer_kwargs", None)
        else:
            object.__setattr__(
                self, "replay_buffer_kwargs", nested("replay_buffer_kwargs", settings, self.replay_buffer_kwargs or {})
            )

    @property
    def hindsight(self) -> HindsightConfig | None:
        """How goals are relabelled, or None where they are not."""
        return self.replay_buffer_kwargs


def rebuild(kind: type[C], saved: Mapping[str, Any], changes: Mapping[str, Any]) -> C:
    """Returns the configuration of a file with some settings changed; of ``policy_kwargs`` only those that are named.

    Raises:
        CheckpointError: if the file names a ``torso`` of the user's own and none is given.
    """
    merged = {**saved, **changes}
    policy, old = changes.get("policy_kwargs"), saved.get("policy_kwargs")
    if isinstance(policy, Mapping) and isinstance(old, Mapping):
        replaced = ("pi", "qf", "vf") if "net_arch" in policy else ()
        merged["policy_kwargs"] = {key: value for key, value in old.items() if key not in replaced} | dict(policy)
    policy = merged.get("policy_kwargs")
    if isinstance(policy, Mapping) and isinstance(torso := policy.get("torso"), str):
        raise CheckpointError(
            f"its networks have a torso of your own, {torso[:40]!r}, and no file holds code; give it again: "
            f"load(path, policy_kwargs=dict(torso={torso[:40]}))"
        )
    return build(kind, merged)


def with_widths(config: C, leaves: tuple[Leaf, ...]) -> C:
    """Returns a configuration whose ``policy_kwargs`` say the widths of hidden layers that were left to the default.

    These depend on the observation, whose ``leaves`` are given.
    """
    kind: Any = type(config)
    widths = kind.hidden_layers_on_images if reads_image(leaves) else kind.hidden_layers
    shape = config.policy_kwargs  # type: ignore[attr-defined]
    said = settled(vars(shape), widths)
    return dataclasses.replace(config, policy_kwargs=dataclasses.replace(shape, **said)) if said else config  # type: ignore


def to_json(config: Any) -> dict[str, Any]:
    """Returns a configuration as plain JSON values, which :func:`build` makes it from again.

    A ``torso`` of the user's own is named only, and must be given again (:func:`rebuild`).
    """
    return {field.name: _value_to_json(getattr(config, field.name)) for field in dataclasses.fields(config)}


def _value_to_json(value: Any) -> Any:
    if isinstance(value, schedules.Linear | schedules.Exponential):
        return schedules.to_json(value)
    if isinstance(value, action_noises.Noise):
        return action_noises.to_json(value)
    if callable(value) and not isinstance(value, tuple):
        return getattr(value, "__name__", type(value).__name__)
    if dataclasses.is_dataclass(value):
        return to_json(value)
    return list(value) if isinstance(value, tuple) else value


def _train_freq(value: Any) -> int | tuple[int, Literal["step", "episode"]]:
    if isinstance(value, tuple | list) and len(value) == 2 and value[1] in ("step", "episode"):
        count = whole("train_freq", value[0], least=1)
        return count if value[1] == "step" else (count, "episode")
    if isinstance(value, int | float):
        return whole("train_freq", value, least=1)
    raise ValueError(f"train_freq={value!r} must be a whole number of steps, or (n, 'step') or (n, 'episode')")
