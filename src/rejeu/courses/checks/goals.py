"""Checks of course 3: goals and hindsight replay."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from rejeu.courses.checks.base import Text, Wrong, call, close, diagnose, exercise, numbers

N = 4_000
"""Draws of a strategy, enough that every time occurs."""


class Step(NamedTuple):
    """A step of an episode in a goal environment."""

    obs: dict[str, np.ndarray]
    """``observation``, ``achieved_goal`` and ``desired_goal`` before the step."""
    action: Any
    reward: float
    next_obs: dict[str, np.ndarray]
    """The same after the step."""
    terminated: bool


@exercise
def compute_reward(student: Any) -> None:
    """Checks ``compute_reward(achieved_goal, desired_goal, info)`` for bits, one goal and a batch."""
    achieved = np.array([[0, 1, 1], [0, 1, 0], [1, 0, 0]], np.int8)
    desired = np.array([[0, 1, 1], [1, 0, 1], [1, 1, 0]], np.int8)
    result = call(student, achieved, desired, {})
    if np.shape(result) == ():
        raise Wrong(
            f"for three goals at once it returns the single number {result}. HER computes the rewards of a whole "
            "batch: along which axis are the bits?",
            f"pour trois buts à la fois, elle renvoie le seul nombre {result}. HER calcule les récompenses d'un lot "
            "entier : sur quel axe sont les bits ?",
        )
    if np.shape(result) == (3, 3):
        raise Wrong(
            "there is a reward for each bit. The goal is reached when all bits agree: combine them along the last "
            "axis.",
            "il y a une récompense par bit. Le but est atteint quand tous les bits coïncident : combinez-les sur "
            "le dernier axe.",
        )
    share = (achieved == desired).mean(axis=-1)
    diagnose(
        numbers(result, (3,)),
        [0, -1, -1],
        (
            [1, 0, 0],
            Text(
                "1 for the goal and 0 elsewhere: here every step costs 1 until the goal is reached, so it is 0 and -1.",
                "1 au but et 0 ailleurs : ici, chaque pas coûte 1 tant que le but n'est pas atteint, donc 0 et -1.",
            ),
        ),
        (
            [-1, 0, 0],
            Text(
                "the goal is punished and everything else is not: the condition is reversed.",
                "le but est puni et le reste ne l'est pas : la condition est inversée.",
            ),
        ),
        (
            share - 1,
            Text(
                "the reward depends on the number of wrong bits. It should only tell whether all of them agree.",
                "la récompense dépend du nombre de bits faux. Elle ne doit dire que si tous coïncident.",
            ),
        ),
        (
            [0, -1, 0],
            Text(
                "one bit in common is enough for you: any or all?",
                "un seul bit en commun vous suffit : any ou all ?",
            ),
        ),
    )
    if not close(numbers(call(student, achieved[1], desired[1], {}), ()), -1):
        raise Wrong(
            "a batch is right, and a single goal of shape (n_bits,) is not.",
            "un lot donne le bon résultat, mais un seul but, de forme (n_bits,), non.",
        )


@exercise
def relabel(student: Any) -> None:
    """Checks ``relabel(step, goal)`` with the reward of bits."""
    a, b, c = (np.array(bits, np.int8) for bits in ([0, 0, 1], [0, 1, 1], [1, 1, 1]))
    missed = Step(_observe(a, c), 1, -1.0, _observe(b, c), False)
    reached = Step(_observe(a, b), 1, 0.0, _observe(b, b), True)
    _one_relabeling(call(student, missed, a), missed, a, achieved=False)
    _one_relabeling(call(student, reached, c), reached, c, achieved=False)
    _one_relabeling(call(student, missed, b), missed, b, achieved=True)


def _observe(achieved: np.ndarray, desired: np.ndarray) -> dict[str, np.ndarray]:
    return {"observation": achieved, "achieved_goal": achieved, "desired_goal": desired}


def _one_relabeling(result: Any, step: Step, goal: np.ndarray, achieved: bool) -> None:
    """Checks a relabeled step; ``achieved``: whether the step reaches its new goal."""
    if getattr(result, "_fields", None) != Step._fields:
        raise Wrong(
            "a Step is expected. step._replace(reward=...) makes a copy with another reward.",
            "il faut un Step. step._replace(reward=...) en fait une copie avec une autre récompense.",
        )
    for name, text in (
        ("obs", Text("before the step", "avant le pas")),
        ("next_obs", Text("after the step", "après le pas")),
    ):
        seen, before = getattr(result, name), getattr(step, name)
        if not isinstance(seen, dict) or seen.keys() != before.keys() or not np.array_equal(seen["desired_goal"], goal):
            raise Wrong(
                f"the observation {text.en} ({name}) does not have the new goal. The critic sees it in s and in s'.",
                f"l'observation {text.fr} ({name}) n'a pas le nouveau but. Le critique le voit dans s et dans s'.",
            )
        if any(not np.array_equal(seen[key], before[key]) for key in ("observation", "achieved_goal")):
            raise Wrong(
                f"in {name} more than the desired goal has changed. What really happened stays as it was.",
                f"dans {name}, il n'y a pas que le but désiré qui a changé. Ce qui s'est réellement passé reste tel "
                "quel.",
            )
    reward, right = numbers(result.reward, ()), 0.0 if achieved else -1.0
    of_before = 0.0 if np.array_equal(step.obs["achieved_goal"], goal) else -1.0
    if close(reward, right) and bool(result.terminated) == achieved:
        return
    if not close(reward, right) and close(reward, of_before) and not close(reward, step.reward):
        raise Wrong(
            f"the reward is {reward:g}: it seems to come from the achieved goal before the step. The reward belongs "
            "to the state that the action leads to.",
            f"la récompense vaut {reward:g} : elle semble venir du but atteint avant le pas. La récompense "
            "appartient à l'état où mène l'action.",
        )
    if not close(reward, right) and close(reward, step.reward):
        raise Wrong(
            f"the goal is new and the reward is still {reward:g}. For the new goal, what would the environment have "
            "returned?",
            f"le but est nouveau, mais la récompense vaut encore {reward:g}. Qu'aurait renvoyé l'environnement pour "
            "ce nouveau but ?",
        )
    if not close(reward, right):
        raise Wrong(
            f"the reward is {reward:g} instead of {right:g}. Use compute_reward.",
            f"la récompense vaut {reward:g} au lieu de {right:g}. Utilisez compute_reward.",
        )
    if achieved:
        raise Wrong(
            "the new goal is reached, and terminated is still False: the target would add the value of a future "
            "that does not exist.",
            "le nouveau but est atteint, mais terminated vaut encore False : la cible ajouterait la valeur d'un "
            "avenir qui n'existe pas.",
        )
    raise Wrong(
        "the flag terminated of the old goal was kept. With the new goal the episode would have gone on, so the "
        "target must include the future.",
        "l'indicateur terminated de l'ancien but a été gardé. Avec le nouveau but, l'épisode aurait continué : la "
        "cible doit donc inclure l'avenir.",
    )


@exercise
def hindsight(student: Any) -> None:
    """Checks ``hindsight(episode, k, rng)``, the steps of an episode with ``k`` relabeled copies of each."""
    states = [np.array([(t >> bit) & 1 for bit in range(4)], np.int8) for t in range(7)]
    goal = np.array([1, 1, 1, 1], np.int8)
    pairs = pairwise(states)
    episode = [Step(_observe(s, goal), t, -1.0, _observe(n, goal), False) for t, (s, n) in enumerate(pairs)]
    result = call(student, episode, 40, np.random.default_rng(0))
    if not isinstance(result, list) or not all(
        isinstance(step, tuple) and hasattr(step, "next_obs") for step in result
    ):
        raise Wrong("a list of steps is expected.", "il faut une liste de pas (Step).")
    if len(result) != 6 * 41:
        raise Wrong(
            f"an episode of 6 steps with k = 40 gives {len(result)} steps, expected 6 x (1 + 40) = 246: each step "
            "once as it was, and k times relabeled.",
            f"un épisode de 6 pas avec k = 40 donne {len(result)} pas au lieu de 6 x (1 + 40) = 246 : chaque pas "
            "une fois tel quel, et k fois avec un autre but.",
        )
    drawn: list[tuple[int, int]] = []
    for step in result:
        time = int(step.action)
        new = step.next_obs["desired_goal"]
        if not np.array_equal(new, goal):
            drawn.append((time, int(new @ (1 << np.arange(4)))))
    if len(drawn) != 240:
        raise Wrong(
            f"{len(drawn)} of the steps have another goal, expected 240. Keep each step with its own goal too.",
            f"{len(drawn)} des pas ont un autre but, au lieu de 240. Gardez aussi chaque pas avec son propre but.",
        )
    _check_times(np.array([time for time, _ in drawn]), np.array([chosen for _, chosen in drawn]), last=6)


def _check_times(time: np.ndarray, chosen: np.ndarray, last: np.ndarray | int) -> None:
    """Checks that the times of the new goals are from ``time + 1`` to ``last``, and that both occur."""
    if (chosen > last).any():
        raise Wrong(
            "some goals come from after the end of the episode, so from another episode: this step cannot lead there.",
            "certains buts viennent d'après la fin de l'épisode, donc d'un autre épisode : ce pas ne peut pas y mener.",
        )
    if (chosen < time).any():
        raise Wrong(
            "some goals come from the past of the step. They show what led to s, and not where the action leads.",
            "certains buts viennent du passé du pas. Ils montrent ce qui a mené à s, et non où mène l'action.",
        )
    if (chosen == time).any():
        raise Wrong(
            "some goals are those achieved in s, before the action. The first goal that the action can have "
            "reached is that of s', one later.",
            "certains buts sont ceux atteints dans s, avant l'action. Le premier but que l'action a pu atteindre "
            "est celui de s', un instant plus tard.",
        )
    inner = time < np.asarray(last) - 1
    if not (chosen == last)[inner].any():
        raise Wrong(
            "the last achieved goal of the episode is never drawn. rng.integers(low, high) excludes high.",
            "le dernier but atteint de l'épisode n'est jamais tiré. rng.integers(low, high) exclut high.",
        )
    if (chosen == last).all():
        raise Wrong(
            "always the last goal: this is the strategy final. Draw a time from time + 1 to last.",
            "toujours le dernier but : c'est la stratégie final. Tirez un instant de time + 1 à last.",
        )
    if not (chosen == time + 1)[inner].any() or (chosen == time + 1).all():
        raise Wrong(
            "the time after the step must occur as often as every later one.",
            "l'instant qui suit le pas doit être tiré aussi souvent que tous les suivants.",
        )


def _draw(student: Callable[..., Any]) -> tuple[np.ndarray, ...]:
    """Returns ``time``, ``first``, ``last`` and the times that a strategy chose for steps of two episodes."""
    rng = np.random.default_rng(0)
    first = np.where(np.arange(N) % 2 == 0, 101, 1)
    last = first + 9
    time = first - 1 + rng.integers(0, 10, N)
    result = call(student, rng, time, first, last)
    if np.shape(result) != (N,):
        raise Wrong(
            f"one time for each of the {N} steps is expected; the result has the shape {np.shape(result)}. "
            "rng.integers takes arrays as bounds.",
            f"il faut un instant pour chacun des {N} pas ; le résultat est de forme {np.shape(result)}. "
            "rng.integers accepte des tableaux comme bornes.",
        )
    chosen = np.asarray(result)
    if chosen.dtype.kind not in "iu":
        raise Wrong(
            f"times are whole numbers, and yours are {chosen.dtype}.",
            f"les instants sont des entiers, et les vôtres sont de type {chosen.dtype}.",
        )
    return time, first, last, chosen


@exercise
def future(student: Any) -> None:
    """Checks ``future(rng, time, first, last)``."""
    time, _, last, chosen = _draw(student)
    _check_times(time, chosen, last)


@exercise
def final(student: Any) -> None:
    """Checks ``final(rng, time, first, last)``."""
    time, first, last, chosen = _draw(student)
    diagnose(
        chosen - last,
        0 * last,
        (
            time - last,
            Text("this is the time of the step itself.", "ceci est l'instant du pas lui-même."),
        ),
        (first - last, Text("this is the first time of the episode.", "ceci est le premier instant de l'épisode.")),
        (
            0 * last - 1,
            Text(
                "this is the last time but one: last itself is allowed.",
                "ceci est l'avant-dernier instant : last lui-même est permis.",
            ),
        ),
    )


@exercise
def episode(student: Any) -> None:
    """Checks ``episode(rng, time, first, last)``."""
    time, first, last, chosen = _draw(student)
    if (chosen < first).any() or (chosen > last).any():
        raise Wrong(
            "some times are outside of the episode, which has the times from first to last.",
            "certains instants sont hors de l'épisode, qui va de first à last.",
        )
    if (chosen > time).all():
        raise Wrong(
            "no time is before the step: this is the strategy future. Here any time of the episode may be drawn.",
            "aucun instant ne précède le pas : c'est la stratégie future. Ici, tout instant de l'épisode peut être "
            "tiré.",
        )
    if not (chosen == last).any():
        raise Wrong(
            "last is never drawn. rng.integers(low, high) excludes high.",
            "last n'est jamais tiré. rng.integers(low, high) exclut high.",
        )
    if not (chosen == first).any():
        raise Wrong("first is never drawn.", "first n'est jamais tiré.")


@exercise
def parking_reward(student: Any) -> None:
    """Checks ``parking_reward(achieved, desired, weights)``."""
    rng = np.random.default_rng(0)
    achieved, desired = rng.normal(size=(2, 5, 6))
    weights = np.array([1.0, 0.3, 0.0, 0.0, 0.02, 0.02])
    gap = abs(achieved - desired)
    result = call(student, achieved, desired, weights)
    if np.shape(result) == ():
        raise Wrong(
            "for a batch of 5 goals it returns a single number. Sum along the last axis.",
            "pour un lot de 5 buts, elle renvoie un seul nombre. Sommez sur le dernier axe.",
        )
    diagnose(
        numbers(result, (5,)),
        -np.sqrt(gap @ weights),
        (
            np.sqrt(gap @ weights),
            Text("the sign is reversed: a distance is a cost.", "le signe est inversé : une distance est un coût."),
        ),
        (
            -(gap @ weights),
            Text(
                "the square root is missing. Near the goal it makes the reward steep.",
                "il manque la racine carrée. Près du but, elle rend la récompense raide.",
            ),
        ),
        (
            -np.sqrt(gap**2 @ weights),
            Text(
                "the differences are squared. The formula has absolute values: the root of a sum of squares is "
                "another norm.",
                "les différences sont au carré. La formule a des valeurs absolues : la racine d'une somme de "
                "carrés est une autre norme.",
            ),
        ),
        (
            -np.sqrt(gap.sum(axis=1)),
            Text(
                "the weights are missing: the speed would count as much as the position.",
                "il manque les poids : la vitesse compterait autant que la position.",
            ),
        ),
        (
            -(np.sqrt(gap) @ weights),
            Text(
                "the root is taken of each term. It belongs around the sum.",
                "la racine est prise sur chaque terme. Elle porte sur la somme.",
            ),
        ),
    )


@exercise
def saving(save_all: Any, load_all: Any, agent: Any, env: Any) -> None:
    """Checks ``save_all(agent, folder)`` and ``load_all(folder, env)`` with an agent that has been trained."""
    spaces = agent.observation_space.spaces
    observations = {name: np.stack([space.sample() for _ in range(256)]) for name, space in spaces.items()}
    with tempfile.TemporaryDirectory() as folder:
        call(lambda: (save_all(agent, Path(folder)), True))
        loaded = call(lambda: load_all(Path(folder), env))
        if type(loaded) is not type(agent):
            raise Wrong(
                f"load_all returns a {type(loaded).__name__} instead of a {type(agent).__name__}.",
                f"load_all renvoie un objet {type(loaded).__name__} au lieu de {type(agent).__name__}.",
            )
        if loaded is agent:
            raise Wrong(
                "load_all returns the agent that was saved and not one from the files. After a restart of the "
                "computer, what would it find?",
                "load_all renvoie l'agent d'origine, et non celui des fichiers. Que trouverait-elle après un "
                "redémarrage de l'ordinateur ?",
            )
        actions = [one.predict(observations, deterministic=True)[0] for one in (agent, loaded)]
        if not np.array_equal(*actions):
            raise Wrong(
                "the loaded agent acts differently: these are not the weights that were saved.",
                "l'agent chargé agit autrement : ce ne sont pas les poids enregistrés.",
            )
        sizes = [one.replay_buffer.size() for one in (agent, loaded)]
        if sizes[0] != sizes[1]:
            raise Wrong(
                f"the agent acts the same, but its replay buffer holds {sizes[1]} steps instead of {sizes[0]}: save "
                "alone does not keep it. It needs a file of its own, when saving and when loading.",
                f"l'agent agit de même, mais sa mémoire de rejeu contient {sizes[1]} pas au lieu de {sizes[0]} : "
                "save seul ne la garde pas. Il lui faut son propre fichier, à l'enregistrement et au chargement.",
            )


@exercise
def steps_needed(answer: Any) -> None:
    """Checks the mean number of episodes until a random agent of 12 bits stands on its goal in the end, about 4,096."""
    number = float(numbers(answer, ()))
    diagnose(
        np.asarray(math.log2(max(number, 1e-9))),
        12.0,
        (
            math.log2(12),
            Text(
                "12 is the number of bits. How many different states are there?",
                "12 est le nombre de bits. Combien y a-t-il d'états différents ?",
            ),
        ),
        (
            math.log2(144),
            Text(
                "the number of states grows faster than the square of the number of bits: each bit doubles it.",
                "le nombre d'états croît plus vite que le carré du nombre de bits : chaque bit le double.",
            ),
        ),
        (
            -12.0,
            Text(
                "this is the probability. The mean number of attempts is its inverse.",
                "ceci est la probabilité. Le nombre moyen d'essais en est l'inverse.",
            ),
        ),
    )
