"""Every setting of every algorithm, changed, changes an update or what is played as its definition says.

A relation is a consequence of a definition that needs no second implementation: with an optimizer whose direction is 1
everywhere, each weight moves by the learning rate. It is checked for every algorithm that has the setting. What only loops,
buffers and networks read is in :data:`ELSEWHERE`, with the tests that show it. A setting in neither fails.

By default a relation is checked for the cheapest algorithms that have a path of their own; ``scripts/test --all`` checks all.
"""

import dataclasses
import itertools
import math
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

import rejeu
from rejeu.agents import AGENTS
from rejeu.algorithms.ars import direction
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.core.algorithm import GRADIENT_STEPS, TD_ERROR, Clock, Rollout, names
from rejeu.core.checkpoint import tree_to_arrays
from rejeu.core.normalization import NormalizationConfig
from rejeu.core.schedules import at
from rejeu.replay.hindsight import HindsightConfig
from rejeu.replay.prioritized import PriorityConfig
from tests.algorithms.batches import (
    ACTION_DIM,
    BOX,
    DISCRETE,
    N_ACTIONS,
    OBS_DIM,
    OBS_SPACE,
    box_batch,
    discrete_batch,
    with_next_action,
)
from tests.tiers import only

ROOT = Path(__file__).parents[2]
SIZE, N_STEPS, N_ENVS = 8, 8, 2
PROGRESS = 0.25
LAST = 1 - PROGRESS
KINDS = {
    **dict.fromkeys(
        ("SAC", "DDPG", "TD3", "TQC", "CrossQ", "IQL", "TD3BC", "ReBRAC", "PPO", "A2C", "TRPO", "RecurrentPPO", "ARS"),
        BOX,
    ),
    **dict.fromkeys(("FlashSAC", "XQC"), BOX),
    **dict.fromkeys(("SAC, Discrete", "DDPG, Discrete", "DQN", "QRDQN", "IQN", "PQN", "MaskablePPO"), DISCRETE),
}
PROJECTED = ("FlashSAC", "XQC")
"""Their weights and gains are scaled after each step; the biases of heads and the temperature are not."""
NOT_LEARNED = ("optimizer", "target_", "key", "n_updates", "n_rollouts", "mean", "variance", "n_batches", "actor_loss")
SMALL = {
    "policy_kwargs": {"net_arch": [5]},
    "optimizer": "sgd",
    "learning_rate": 0.1,
    "max_grad_norm": None,
    "policy_delay": 1,
    "tau": 0.25,
    "target_update_interval": 1,
    "target_policy_noise": 0.0,
    "n_steps": N_STEPS,
    "batch_size": N_STEPS * N_ENVS,
    "n_epochs": 1,
    "n_critic_updates": 1,
    "normalize_advantage": False,
    "n_quantiles": 5,
    "n_target_quantiles": 5,
    "n_bins": 7,
    "n_delta": 4,
}
"""One gradient step of each part, without any limit, as far as an algorithm has the setting."""


class Result(NamedTuple):
    """An update: the arrays of the state before and after by name, the metrics, and the state itself."""

    before: dict[str, np.ndarray]
    after: dict[str, np.ndarray]
    metrics: dict[str, Any]
    state: Any

    @property
    def moved(self) -> dict[str, np.ndarray]:
        """How far each learned array moved."""
        return {name: self.after[name] - self.before[name] for name in self.before if is_learned(name, self.before)}

    @property
    def first(self) -> dict[str, np.ndarray]:
        """The same of the part that learns first, whose gradient no other step of the update has changed."""
        part = next(
            part
            for part in ("value.", "critics.", "critic.", "network.")
            if any(map(part.__eq__, parts_of(self.before)))
        )
        return {name: value for name, value in self.moved.items() if name.startswith(part)}


def parts_of(arrays: dict[str, np.ndarray]) -> set[str]:
    return {name.partition(".")[0] + "." for name in arrays}


def is_learned(name: str, arrays: dict[str, np.ndarray]) -> bool:
    fields = name.split(".")
    return (
        arrays[name].dtype == np.float32
        and not any(
            field == word or (word in ("optimizer", "target_") and word in field)
            for field in fields
            for word in NOT_LEARNED
        )
        and name != "entropy"
    )


def is_of_value(name: str) -> bool:
    """Whether an array of an actor-critic belongs to the value alone."""
    return "value_" in name or ".cells.1" in name


class Case(NamedTuple):
    """An algorithm with a kind of action space."""

    name: str

    @property
    def kind(self) -> str:
        return self.name.split(",")[0]

    @property
    def space(self) -> gym.Space:
        return KINDS[self.name]

    @property
    def algorithm(self) -> Any:
        return AGENTS[self.kind].algorithm

    @property
    def fields(self) -> dict[str, str]:
        """The settings with their types as text."""
        return {field.name: str(field.type) for field in dataclasses.fields(self.algorithm.Config)}

    @property
    def off_policy(self) -> bool:
        return issubclass(self.algorithm.Config, OffPolicyConfig)

    def config(self, **settings: Any) -> Any:
        small = {key: value for key, value in SMALL.items() if key in self.fields}
        if self.off_policy:
            small["n_steps"] = 1
        if self.kind == "RecurrentPPO":
            small["policy_kwargs"] = {"net_arch": [5], "lstm_hidden_size": 4}
        return self.algorithm.Config(**small | settings)

    def make(self, **settings: Any) -> Any:
        return self.algorithm.make(self.config(**settings), OBS_SPACE, self.space)

    def state(self, made: Any) -> Any:
        """Returns a state whose targets are drawn apart from its networks, and whose policy depends on what is seen."""
        state, other = (made.init(jax.random.PRNGKey(seed)) for seed in (1, 2))
        for name in [name for name in vars(state) if name.startswith("target_")]:
            if (drawn := getattr(other, name)) is None:
                continue
            state = eqx.tree_at(lambda s, name=name: getattr(s, name), state, drawn)
        if self.kind == "MaskablePPO":  # PPO's policies begin almost uniform
            weight = state.network.head.weight
            state = eqx.tree_at(lambda s: s.network.head.weight, state, 100.0 * weight)
        return state

    def batch(self, made: Any, state: Any) -> Any:
        """Returns a batch of transitions or a rollout."""
        if self.off_policy:
            batch = (box_batch if self.space is BOX else discrete_batch)(0, SIZE)
            return with_next_action(batch, 0) if self.kind == "ReBRAC" else batch
        rng = np.random.default_rng(0)
        shape = (N_STEPS, N_ENVS)
        how = rng.integers(4, size=shape)
        obs, next_obs = rng.normal(size=(2, *shape, OBS_DIM)).astype(np.float32)
        box = np.tanh(rng.normal(size=(*shape, ACTION_DIM))).astype(np.float32)
        carry = made.explorer.init(made.actor(state), N_ENVS) if self.kind == "RecurrentPPO" else ()
        ended = np.tile(np.arange(N_STEPS)[:, None] % 2 == 1, N_ENVS) if self.kind == "ARS" else (how == 1) | (how == 2)
        return Rollout(
            obs=obs,
            action=box if self.space is BOX else rng.integers(N_ACTIONS, size=shape, dtype=np.int32),
            reward=rng.normal(size=shape).astype(np.float32),
            next_obs=next_obs,
            discount=np.where(how == 1, 0.0, 0.9).astype(np.float32),
            ended=ended,
            valid=np.ones(shape, bool),
            running_return=np.zeros(shape, np.float32),
            started=np.ones(N_ENVS, bool),
            carry=carry,
        )

    def update(
        self, change: Callable[[Any], Any] = lambda batch: batch, state: Any = None, step: int = 1, **settings: Any
    ) -> Result:
        """Takes an update, from ``state`` if given, on the batch that ``change`` returns of the usual one."""
        key = self.name, repr(settings)
        if key not in MADE:
            made = self.make(**settings)
            MADE[key] = made, jax.jit(made.update)
        made, update = MADE[key]
        state = self.state(made) if state is None else state
        batch = jax.tree.map(jnp.asarray, change(self.batch(made, state)))
        after, metrics = update(state, batch, clock(step=step))
        return Result(tree_to_arrays(state), tree_to_arrays(after), metrics, after)


MADE: dict[tuple[str, str], tuple[Any, Any]] = {}
"""Algorithms and their compiled updates, by case and settings."""


def clock(progress: float = PROGRESS, step: int = 1) -> Clock:
    return Clock(np.uint32(step), np.uint32(0), np.float32(progress))


def norm(arrays: Any) -> float:
    return math.sqrt(sum(float(np.sum(np.square(np.float64(array)))) for array in arrays))


def close(one: dict[str, np.ndarray], two: dict[str, np.ndarray], factor: float = 1.0, atol: float = 2e-6) -> None:
    assert one.keys() == two.keys()
    assert one
    for name, value in one.items():
        np.testing.assert_allclose(value, factor * two[name], rtol=1e-3, atol=atol, err_msg=name)


def differ(one: dict[str, np.ndarray], two: dict[str, np.ndarray], least: float = 1e-5) -> bool:
    assert one.keys() == two.keys()
    return any(np.max(np.abs(np.float64(value) - two[name]), initial=0.0) > least for name, value in one.items())


def parallel(one: dict[str, np.ndarray], two: dict[str, np.ndarray]) -> float:
    """Returns the cosine of the angle between two steps."""
    dot = sum(float(np.sum(np.float64(value) * two[name])) for name, value in one.items())
    return dot / (norm(one.values()) * norm(two.values()))


Relation = Callable[[Case], None]
SHOWN: dict[str, list[Relation]] = {}
"""The relations of each setting."""
DEFAULT: dict[Relation, tuple[str, ...]] = {}
"""The cases for which each relation is checked by default."""


def shows(*fields: str, by: str) -> Callable[[Relation], Relation]:
    """Declares that a relation shows what settings do, by default for the cases ``by``, separated by ``/``."""

    def register(relation: Relation) -> Relation:
        for field in fields:
            SHOWN.setdefault(field, []).append(relation)
        DEFAULT[relation] = tuple(by.split("/"))
        return relation

    return register


# What every algorithm has.

UNIT = optax.GradientTransformation(
    lambda params: optax.EmptyState(), lambda updates, state, params=None: (jax.tree.map(minus_one, updates), state)
)
"""An optimizer whose direction is 1 for every number, whatever the gradient is."""


def minus_one(leaf: Any) -> Any:
    return -jnp.ones_like(leaf)


@shows("learning_rate", "critic_learning_rate", by="DQN/PPO/PQN/CrossQ/IQL")
def every_weight_moves_by_its_learning_rate(case: Case) -> None:
    if case.kind == "ARS":
        one, two = (case.update(learning_rate=rate) for rate in (0.1, 0.2))
        return close(two.moved, one.moved, 2.0)
    rate, own = rejeu.Linear(0.5, 0.1), rejeu.Linear(0.05, 0.45)
    settings = {"optimizer": UNIT, "learning_rate": rate}
    for name, moved in case.update(**settings).moved.items():
        if case.kind in PROJECTED and name not in ("actor.head.bias", "critics.head.bias", "log_alpha"):
            continue
        if case.kind != "TRPO" or is_of_value(name):  # its policy has a step of its own
            moved = np.abs(moved) if name == "log_alpha" else -moved  # Adam's first step
            np.testing.assert_allclose(moved, at(rate, PROGRESS), rtol=1e-4, atol=1e-6, err_msg=name)
    if "critic_learning_rate" in case.fields and case.kind != "RecurrentPPO":
        for name, moved in case.update(**settings, critic_learning_rate=own).moved.items():
            expected = at(own if is_of_value(name) else rate, PROGRESS)
            np.testing.assert_allclose(-moved, expected, rtol=1e-4, atol=1e-6, err_msg=name)


@shows("max_grad_norm", "clip_grad_value", "optimizer", by="DQN/QRDQN/PQN/IQL")
def gradients_are_limited_and_then_given_to_the_optimizer(case: Case) -> None:
    """With plain gradient descent at the rate 1 the step is the gradient."""
    if case.kind in PROJECTED:  # the step is projected: seen from the biases of heads, which are not
        free, limited = case.update(learning_rate=1.0), case.update(learning_rate=1.0, max_grad_norm=1e-2)
        twice = case.update(learning_rate=1.0, optimizer=optax.scale(-2.0))
        bias = lambda one: {"bias": one.moved["critics.head.bias"]}  # noqa: E731
        close(bias(twice), bias(free), 2.0)
        assert 0 < norm(bias(limited).values()) < min(1e-2, norm(bias(free).values()))
        return
    free = case.update(learning_rate=1.0)
    policy = lambda name: case.kind == "TRPO" and not is_of_value(name)  # noqa: E731
    parts = lambda moved: {  # noqa: E731
        part: {name: m for name, m in moved.items() if name.startswith(part + ".") and not policy(name)}
        for part in ("actor", "value", "critics", "critic", "network")
        if any(name.startswith(part + ".") for name in moved)
    }
    limited = parts(case.update(learning_rate=1.0, max_grad_norm=1e-2).moved)
    assert set(limited) == set(parts(free.moved))
    for part, moved in limited.items():
        assert norm(moved.values()) == pytest.approx(1e-2, rel=1e-2), part
    ((part, gradient),) = parts(free.first).items()
    close(limited[part], gradient, 1e-2 / norm(gradient.values()), atol=1e-6)
    twice = case.update(learning_rate=1.0, optimizer=optax.scale(-2.0))
    close(parts(twice.first)[part], gradient, 2.0)
    if "clip_grad_value" in case.fields:
        assert max(np.abs(g).max() for g in gradient.values()) > 0.02
        bounded = case.update(learning_rate=1.0, clip_grad_value=0.01)
        close(bounded.first, {name: np.clip(g, -0.01, 0.01) for name, g in gradient.items()})


# Targets.


@shows("tau", "target_update_interval", by="DQN/IQL")
def targets_move_the_share_tau_of_the_way_once_an_interval(case: Case) -> None:
    for tau in (0.25, 1.0):
        one = case.update(tau=tau, step=2, target_update_interval=2) if is_q(case) else case.update(tau=tau)
        targets = [name for name in one.before if name.startswith("target_")]
        assert targets
        for name in targets:  # DQN's moves before the gradient step
            online = (one.before if is_q(case) else one.after)[name.removeprefix("target_")]
            expected = one.before[name] + tau * (online - one.before[name])
            np.testing.assert_allclose(one.after[name], expected, rtol=1e-5, atol=1e-6, err_msg=name)
    if "target_update_interval" in case.fields:
        moves, state = [], None
        for step in (1, 2, 3, 4, 5, 6):
            found = case.update(target_update_interval=3, state=state, step=step)
            moves.append(any((found.after[name] != found.before[name]).any() for name in targets))
            state = found.state
        assert moves == [False, False, True] * 2


def is_q(case: Case) -> bool:
    return case.kind in ("DQN", "QRDQN", "IQN")


@shows("critic_layer_norm", by="ReBRAC")
def critics_alone_have_layer_norm(case: Case) -> None:
    shapes = lambda on: jax.eval_shape(case.make(critic_layer_norm=on).init, jax.random.PRNGKey(0))  # noqa: E731
    state = case.make(critic_layer_norm=False, policy_kwargs={"net_arch": [5], "layer_norm": True})
    state = jax.eval_shape(state.init, jax.random.PRNGKey(0))
    assert names(shapes(True).critics) == names(state.critics)
    assert names(shapes(True).actor) == names(shapes(False).actor)
    assert names(shapes(True).critics) != names(shapes(False).critics)


@shows("policy_delay", by="CrossQ")
def the_actor_learns_once_a_delay(case: Case) -> None:
    moves, state = [], None
    for _ in range(4):
        found = case.update(policy_delay=2, state=state)
        delayed = [name for name in found.before if name.startswith(("actor.", "target_"))]
        if "ent_coef" in case.fields:  # the targets follow the critics
            delayed = [name for name in delayed if name.startswith("actor.")]
        moves.append({bool((found.after[name] != found.before[name]).any()) for name in delayed if "bias" in name})
        state = found.state
    assert moves == [{False}, {True}] * 2


@shows("target_policy_noise", "target_noise_clip", by="TD3")
def the_targets_noise_is_scaled_and_then_clipped(case: Case) -> None:
    error = lambda noise, clip: case.update(  # noqa: E731
        target_policy_noise=noise, target_noise_clip=clip
    ).metrics[TD_ERROR]
    none = error(0.0, 0.5)
    np.testing.assert_array_equal(none, error(0.3, 0.0))
    np.testing.assert_allclose(error(1e6, 0.1), error(1e7, 0.1), atol=1e-6)
    by = [np.abs(error(noise, 5.0) - none).max() for noise in (1e-3, 1e-2)]
    assert by[1] == pytest.approx(10 * by[0], rel=0.2)
    assert 1e-4 < by[1] < np.abs(error(1e6, 0.1) - none).max()


# Values.


@shows("loss", by="DQN")
def the_loss_is_the_mean_of_its_function_of_the_errors(case: Case) -> None:
    large = lambda batch: batch._replace(reward=3.0 * batch.reward)  # noqa: E731
    for loss, of in (("squared", np.square), ("huber", lambda e: np.where(e < 1, 0.5 * e**2, e - 0.5))):
        metrics = case.update(large, loss=loss).metrics
        errors = np.float64(metrics[TD_ERROR])
        assert errors.min() < 1 < errors.max()
        assert float(metrics["loss"]) == pytest.approx(np.mean(of(errors)), rel=1e-5)


@shows("n_critics", "n_quantiles", "dueling", by="DQN/QRDQN/TQC/SAC")
def the_critics_have_the_number_and_outputs_asked_for(case: Case) -> None:
    shapes = lambda **settings: {  # noqa: E731
        name: leaf.shape
        for made in [case.make(**settings)]
        for tree in [jax.eval_shape(made.init, jax.random.PRNGKey(0))]
        for name, leaf in zip(names(tree), jax.tree.leaves(tree), strict=True)
    }
    for n in (1, 3) if "n_critics" in case.fields else ():
        assert {shape[0] for name, shape in shapes(n_critics=n).items() if name.startswith("critics.")} == {n}
    if "n_quantiles" in case.fields and case.kind != "IQN":
        critics = "critics." if case.kind == "TQC" else "network."
        heads = [s[-1] for name, s in shapes(n_quantiles=7).items() if name.startswith(critics) and "head.bias" in name]
        assert heads == [7 * (1 if case.kind == "TQC" else N_ACTIONS)]
    if "dueling" in case.fields:
        assert not [name for name in shapes(dueling=False) if "advantage" in name]
        moved = {name for name, m in case.update(dueling=True).moved.items() if (m != 0).any()}
        assert {name.split(".")[-2] for name in moved} >= {"value_head", "advantage_head"}


@shows("target_entropy", by="CrossQ")
def the_temperature_rises_where_the_entropy_is_below_its_target(case: Case) -> None:
    """And its loss is ``log alpha (entropy - target)``."""
    automatic = -ACTION_DIM if case.space is BOX else 0.3 * math.log(N_ACTIONS)
    automatic *= 0.5 if case.kind == "XQC" else 1.0
    entropy = float(case.update().metrics["entropy"])
    for given, target in (("auto", automatic), (entropy + 0.5, entropy + 0.5)):
        found = case.update(target_entropy=given, ent_coef="auto_0.3")
        rest = float(found.metrics["ent_coef_loss"]) / math.log(0.3)
        assert float(found.metrics["entropy"]) - rest == pytest.approx(target, abs=1e-4)
        assert np.sign(found.moved["log_alpha"]) == np.sign(target - float(found.metrics["entropy"]))


@shows("use_sde", "sde_sample_freq", "sde_log_std_init", by="SAC")
def state_dependent_noise_stays_for_so_many_steps(case: Case) -> None:
    if case.kind == "RecurrentPPO":
        return  # refuses it
    own = {"sde_log_std_init": -1.5} if "sde_log_std_init" in case.fields else {"policy_kwargs": {"log_std_init": -1.5}}
    for freq, kept in ((2, [True, False, True, False]), (-1, [True] * 4)) if case.space is BOX else ():
        made = case.make(use_sde=True, sde_sample_freq=freq, **own)
        actor = made.actor(made.init(jax.random.PRNGKey(0)))
        log_std, matrices = actor.log_std, []
        carry, obs = made.explorer.init(actor, 1), jnp.ones((1, OBS_DIM))
        for i in range(5):
            ended, key = jnp.array([i == 0]), jax.random.PRNGKey(i)
            _, carry = made.explorer.act(carry, actor, obs, ended, key, clock())
            matrices.append(carry[0])
        np.testing.assert_allclose(log_std, -1.5, rtol=1e-6)
        assert [bool((a == b).all()) for a, b in itertools.pairwise(matrices)] == kept
    assert case.make().explorer is None


# Exploration of Q-learning.


@shows("exploration_initial_eps", "exploration_final_eps", "exploration_fraction", "exploration_schedule", by="DQN")
def so_large_a_share_of_the_actions_is_random(case: Case) -> None:
    n = 4000
    settings = {"exploration_initial_eps": 0.8, "exploration_final_eps": 0.2, "exploration_fraction": 0.5}
    obs = np.random.default_rng(0).normal(size=(n, OBS_DIM)).astype(np.float32)
    for schedule, middle in (("linear", 0.5), ("exponential", 0.4)):
        made = case.make(**settings, exploration_schedule=schedule)
        state = case.state(made)
        greedy = made.exploit(made.actor(state), obs)
        for progress, epsilon in ((0.0, 0.8), (0.25, middle), (0.5, 0.2), (1.0, 0.2)):
            taken = made.explore(made.actor(state), obs, jax.random.PRNGKey(3), clock(progress))
            assert np.mean(taken != greedy) == pytest.approx(epsilon * (1 - 1 / N_ACTIONS), abs=0.03)
    rate = case.update(**settings).metrics["exploration_rate"]
    assert float(rate) == pytest.approx(0.5)


# Rollouts.


@shows("batch_size", "n_epochs", "n_critic_updates", by="PQN")
def a_rollout_is_learned_from_so_often_in_parts_of_so_many_steps(case: Case) -> None:
    """With an optimizer whose direction is 1, weights show the number of gradient steps."""
    if case.off_policy:
        return  # a batch is what the buffer draws: see ELSEWHERE
    passes = "n_critic_updates" if case.kind == "TRPO" else "n_epochs"
    for n_passes, batch_size, expected in ((3, 16, 3), (2, 8, 4), (1, 100, 1)):
        settings = {passes: n_passes, "batch_size": batch_size, "optimizer": UNIT, "learning_rate": 1e-3}
        found = case.update(**settings)
        name = next(name for name in found.moved if is_of_value(name) or case.kind == "PQN")
        np.testing.assert_allclose(-found.moved[name], expected * 1e-3, rtol=1e-2)
        assert float(found.metrics[GRADIENT_STEPS]) == expected + (case.kind == "TRPO")


@shows("gae_lambda", "q_lambda", by="PQN")
def lambda_says_how_far_rewards_reach_back(case: Case) -> None:
    """0 is cutting the rollout after every step, and without bootstrapping nothing depends on it."""
    key = "q_lambda" if case.kind == "PQN" else "gae_lambda"
    update = lambda value, **changes: case.update(lambda batch: batch._replace(**changes), **{key: value})  # noqa: E731
    none, half, one = (update(value) for value in (0.0, 0.5, 1.0))
    assert differ(none.moved, half.moved)
    assert differ(half.moved, one.moved)
    if case.kind != "RecurrentPPO":  # whose memory also ends
        close(update(1.0, ended=np.ones((N_STEPS, N_ENVS), bool)).moved, none.moved)
    alone = np.zeros((N_STEPS, N_ENVS), np.float32)
    close(update(1.0, discount=alone).moved, update(0.0, discount=alone).moved)


def normal_divergence(mean: Any, log_std: Any, other_mean: Any, other_log_std: Any) -> float:
    """Returns the mean KL divergence of the second normal distribution from the first."""
    variance, other = np.exp(2 * log_std), np.exp(2 * other_log_std)
    each = other_log_std - log_std + (variance + (mean - other_mean) ** 2) / (2 * other) - 0.5
    return float(np.mean(np.sum(np.broadcast_to(each, mean.shape), axis=-1)))


@shows("target_kl", by="TRPO")
def the_divergence_is_bounded(case: Case) -> None:
    if case.kind == "TRPO":
        reached = [float(case.update(target_kl=kl).metrics["kl_divergence_loss"]) for kl in (1e-3, 1e-2)]
        assert 0.2e-3 < reached[0] < 1e-3
        assert 0.2e-2 < reached[1] < 1e-2
        made = case.make()
        state = case.state(made)
        found = case.update(target_kl=0.5, state=state)
        obs = case.batch(made, state).obs.reshape(-1, OBS_DIM)
        old, new = ([np.float64(part) for part in s.network.policy(jnp.asarray(obs))[:2]] for s in (state, found.state))
        there, back = normal_divergence(*old, *new), normal_divergence(*new, *old)
        assert abs(there - back) > 0.02 * there
        assert float(found.metrics["kl_divergence_loss"]) == pytest.approx(there, rel=1e-3)
        return
    settings = {"n_epochs": 5, "learning_rate": 0.3}
    steps = [float(case.update(target_kl=kl, **settings).metrics[GRADIENT_STEPS]) for kl in (None, 1e6, 1e-6)]
    assert steps == [5, 5, 1]  # the first step starts at the policy that acted


# ARS.


@shows("zero_policy", "delta_std", by="ARS")
def the_search_begins_at_zero_and_perturbs_by_its_deviation(case: Case) -> None:
    for zero in (True, False):
        made = case.make(zero_policy=zero, delta_std=0.1, policy_kwargs={})
        state = made.init(jax.random.PRNGKey(0))
        assert zero == (not any(leaf.any() for leaf in jax.tree.leaves(state.actor.network)))
        for std in (0.1, 0.3):
            made = case.make(zero_policy=zero, delta_std=std, policy_kwargs={})
            carry = made.explorer.init(state.actor, 1)
            started = jnp.ones(1, bool)
            obs = jnp.ones((1, OBS_DIM))
            _, playing = made.explorer.act(carry, state.actor, obs, started, jax.random.PRNGKey(0), clock())
            expected = jax.tree.map(lambda n, d, s=std: n + s * d, state.actor.network, direction(state.actor, 0))
            jax.tree.map(lambda p, e: np.testing.assert_allclose(p[0], e, atol=1e-6), playing.network, expected)


@shows("n_delta", "n_top", "n_eval_episodes", "alive_bonus_offset", by="")
def returns_of_whole_episodes_weigh_the_directions(case: Case) -> None:
    """Eight episodes in the rollout: 2 of 2 steps in each of 2 environments, twice."""
    made, four = case.make(), case.update(n_delta=4)
    state = made.init(jax.random.PRNGKey(1))
    close(case.update(n_delta=4, n_top=4).moved, four.moved)
    best = case.update(n_delta=4, n_top=1).moved
    leaves = lambda k: dict(enumerate(map(np.asarray, jax.tree.leaves(direction(state.actor, k)))))  # noqa: E731
    assert [abs(parallel(dict(enumerate(best.values())), leaves(k))) > 0.999 for k in range(4)].count(True) == 1
    higher = lambda batch: batch._replace(reward=batch.reward + 0.7)  # noqa: E731
    offset = case.update(alive_bonus_offset=0.7)
    assert float(offset.metrics["return_mean"]) == pytest.approx(float(four.metrics["return_mean"]) + 1.4, rel=1e-4)
    close(offset.moved, case.update(higher).moved)
    # The episodes of an environment that repeat are the second evaluation of the same directions.
    again = lambda batch: batch._replace(reward=np.tile(batch.reward[:4], (2, 1)))  # noqa: E731
    once = lambda batch: jax.tree.map(lambda x: x[:4] if x.ndim > 1 else x, batch)  # noqa: E731
    close(case.update(again, n_delta=2, n_eval_episodes=2).moved, case.update(once, n_delta=2).moved)


# The table.

CASES = [Case(name) for name in KINDS]
NESTED = (HindsightConfig, PriorityConfig, NormalizationConfig)
RELATIONS = [
    (relation, case)
    for relation in dict.fromkeys(relation for relations in SHOWN.values() for relation in relations)
    for case in CASES
    if any(relation in SHOWN[field] for field in case.fields if field in SHOWN)
]


@pytest.mark.parametrize(
    "pair",
    only([p for p in RELATIONS if p[1].name in DEFAULT[p[0]]], RELATIONS),
    ids=[f"{relation.__name__}-{case.name}" for relation, case in RELATIONS],
)
def test_a_setting_does_what_its_definition_says(pair: tuple[Relation, Case]) -> None:
    relation, case = pair
    relation(case)


SCHEDULES = [
    (case, field)
    for case in CASES
    for field, kind in case.fields.items()
    if "Schedule" in kind and (case.name, field) != ("RecurrentPPO", "critic_learning_rate")
]
RANGES = {"learning_rate": (0.5, 0.1), "ent_coef": (1.0, 0.0), "delta_std": (1.0, 0.1)}
"""Ends of the schedules that are tried; other settings take (0.4, 0.01)."""


def outcome(case: Case, **settings: Any) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Returns what an update leaves and what is played at :data:`PROGRESS`, and the metrics of the update."""
    found = case.update(**settings)
    played = {}
    if case.kind == "ARS":
        made = case.make(**settings)
        actor = made.actor(made.init(jax.random.PRNGKey(1)))
        carry, obs = made.explorer.init(actor, 2), jnp.ones((2, OBS_DIM))
        played["action"], carry = made.explorer.act(
            carry, actor, obs, jnp.ones(2, bool), jax.random.PRNGKey(0), clock()
        )
    metrics = {name: np.asarray(value) for name, value in found.metrics.items()}
    return found.after | {name: np.asarray(value) for name, value in played.items()}, metrics


@pytest.mark.parametrize(
    "pair",
    only([p for p in SCHEDULES if (p[0].name, p[1]) in (("ARS", "delta_std"), ("DQN", "learning_rate"))], SCHEDULES),
    ids=[f"{case.name}-{field}" for case, field in SCHEDULES],
)
def test_a_schedule_is_its_value_at_the_progress_of_the_clock(pair: tuple[Case, str]) -> None:
    """In everything that an update leaves and reports; and that differs from its value elsewhere."""
    case, field = pair
    rest = {"n_epochs": 3} if "clip" in field else {}
    if field != "learning_rate":
        rest["learning_rate"] = 0.5
    schedule = rejeu.Linear(*RANGES.get(field, (0.4, 0.01)))
    followed, reported = outcome(case, **rest, **{field: schedule})
    same, same_reported = outcome(case, **rest, **{field: schedule(PROGRESS)})
    close(followed, same)
    close(reported, same_reported)
    other, _ = outcome(case, **rest, **{field: schedule(LAST)})
    assert differ(followed, other)


ELSEWHERE = {
    setting: test
    for test, settings in tomllib.loads(Path(__file__).with_name("settings_elsewhere.toml").read_text("utf-8")).items()
    for setting in settings
}
"""By setting, the test of the loop, buffer or network that reads it."""


def test_every_setting_is_in_one_of_the_tables() -> None:
    kinds = {type(kind.algorithm.Config().policy_kwargs) for kind in AGENTS.values()}
    nested = [field.name for kind in (*kinds, *NESTED) for field in dataclasses.fields(kind)]
    settings = {field for case in CASES for field in case.fields} | set(nested)
    assert settings - SHOWN.keys() - ELSEWHERE.keys() == set()
    assert (SHOWN.keys() | ELSEWHERE.keys()) - settings == set()
    own = {name for name, kind in AGENTS.items() if kind.algorithm.make.__module__ == kind.algorithm.__name__}
    assert own <= {case.kind for case in CASES} <= set(AGENTS)  # others are settings of one of these


def test_what_shows_a_setting_elsewhere_is_there() -> None:
    for place in set(ELSEWHERE.values()):
        file, _, name = place.partition("::")
        assert f"\ndef {name}(" in (ROOT / file).read_text(encoding="utf-8"), place
