"""Checks of course 1: DQN and PPO from their parts."""

from __future__ import annotations

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from rejeu.core import Transition
from rejeu.courses.checks.base import Text, Wrong, call, close, compiles, diagnose, exercise, numbers


@exercise
def replay_memory(student: Any) -> None:
    """Checks the class ``ReplayMemory(capacity, obs_size)`` with ``push``, ``sample`` and ``len``."""
    memory = call(student, 4, 2)
    for i in range(1, 4):
        call(memory.push, np.full(2, i), i, 10.0 * i, np.full(2, i + 0.5), 0.1 * i, may_return_none=True)
    _check_length(memory, 3)
    seen = _sampled(memory)
    if seen == {0}:
        raise Wrong(
            "all that sample returns is 0. Does push write the transition to the arrays?",
            "tout ce que sample renvoie vaut 0. push écrit-il la transition dans les tableaux ?",
        )
    if 0 in seen:
        raise Wrong(
            "after 3 of 4 pushes, sample returned a row that was never filled. From which rows may it draw?",
            "après 3 ajouts sur 4 places, sample a renvoyé une ligne jamais remplie. Parmi quelles lignes peut-il "
            "tirer ?",
        )
    for i in range(4, 7):
        call(memory.push, np.full(2, i), i, 10.0 * i, np.full(2, i + 0.5), 0.1 * i, may_return_none=True)
    _check_length(memory, 4)
    seen = _sampled(memory)
    if {5, 6} - seen:
        raise Wrong(
            "after 6 pushes into 4 places, the newest transitions are missing. Which place does a full memory give up?",
            "après 6 ajouts dans 4 places, les transitions les plus récentes manquent. Quelle place une mémoire pleine "
            "cède-t-elle ?",
        )
    if seen != {3, 4, 5, 6}:
        raise Wrong(
            f"after 6 pushes into 4 places, sample returns the transitions {sorted(seen)}, expected 3 to 6: the oldest "
            "ones are overwritten, and each of the others may be drawn.",
            f"après 6 ajouts dans 4 places, sample renvoie les transitions {sorted(seen)} au lieu de 3 à 6 : les plus "
            "anciennes sont écrasées, et chacune des autres peut être tirée.",
        )


def _check_length(memory: Any, expected: int) -> None:
    length = call(len, memory, copies=False)
    if length != expected:
        raise Wrong(
            f"len is {length}, but {expected} transitions can be in the memory.",
            f"len vaut {length}, mais la mémoire peut contenir {expected} transitions.",
        )


def _sampled(memory: Any) -> set[int]:
    """Returns the numbers of the transitions that sampling finds.

    Raises:
        Wrong: if batches have wrong shapes, mix transitions or are all the same.
    """
    rng, found = np.random.default_rng(0), []
    for _ in range(60):
        batch = call(memory.sample, 2, rng, copies=False)
        if not isinstance(batch, tuple | list) or len(batch) != 5:
            raise Wrong(
                "sample must return five arrays: obs, action, reward, next_obs and discount.",
                "sample doit renvoyer cinq tableaux : obs, action, reward, next_obs et discount.",
            )
        shapes = ((2, 2), (2,), (2,), (2, 2), (2,))
        obs, action, reward, next_obs, discount = (numbers(x, s) for x, s in zip(batch, shapes, strict=True))
        rows = np.stack([obs[:, 0], action, reward / 10, next_obs[:, 0] - 0.5 * (obs[:, 0] > 0), discount * 10])
        if not close(rows, np.tile(rows[0], (5, 1))):
            raise Wrong(
                "obs, action, reward, next_obs and discount of one row belong to different transitions. Are they "
                "indexed by the same draw, and written to the same place?",
                "obs, action, reward, next_obs et discount d'une même ligne appartiennent à des transitions "
                "différentes. Sont-ils indexés par le même tirage, et écrits à la même place ?",
            )
        found.append(np.round(rows[0]).astype(int))
    if found[0].any() and all((one == found[0]).all() for one in found):
        raise Wrong(
            "60 batches were all the same. Draw the rows with rng.",
            "60 lots successifs sont identiques. Tirez les lignes avec rng.",
        )
    return set(np.concatenate(found).tolist())


@exercise
def discounts(student: Any) -> None:
    """Checks ``discounts(terminated, truncated, gamma)``."""
    terminated, truncated = np.array([False, True, False, True]), np.array([False, False, True, True])
    result = numbers(call(student, terminated, truncated, 0.9), (4,))
    diagnose(
        result,
        [0.9, 0.0, 0.9, 0.0],
        (
            [0.9, 0.0, 0.0, 0.0],
            Text(
                "a truncated episode is treated as a terminated one. Is the car's future worth nothing because the "
                "clock ran out?",
                "un épisode tronqué est traité comme un épisode terminé. L'avenir de la voiture ne vaut-il rien "
                "parce que le temps imparti est écoulé ?",
            ),
        ),
        (
            [0.9, 0.9, 0.9, 0.9],
            Text(
                "a terminated step still has a future. What can be earned after the end?",
                "un pas terminal garde un avenir. Que peut-on encore gagner après la fin ?",
            ),
        ),
        (
            [0.0, 0.9, 0.0, 0.9],
            Text(
                "it is the wrong way around: only terminated steps have a future.",
                "c'est l'inverse : seuls les pas terminaux ont un avenir.",
            ),
        ),
        (
            [0.9, 0.9, 0.0, 0.0],
            Text(
                "truncation ends the future, and termination does not. Which of the two is an event of the task "
                "itself?",
                "la troncature supprime l'avenir, la terminaison non. Laquelle des deux est un événement de la tâche "
                "elle-même ?",
            ),
        ),
        ([1.0, 0.0, 1.0, 0.0], Text("where is gamma?", "où est gamma ?")),
    )


@exercise
def td_targets(student: Any) -> None:
    """Checks ``td_targets(reward, discount, next_q)``."""
    reward, discount = jnp.array([1.0, -1.0, 2.0]), jnp.array([0.9, 0.5, 0.0])
    next_q = jnp.array([[1.0, 3.0], [4.0, 2.0], [5.0, 6.0]])
    best = next_q.max(axis=1)
    diagnose(
        numbers(call(student, reward, discount, next_q), (3,)),
        reward + discount * best,
        (
            reward + best,
            Text(
                "the discount is missing, so that even a step that terminated has a future.",
                "il manque l'actualisation (discount) : même un pas terminal a ainsi un avenir.",
            ),
        ),
        (
            reward + discount * next_q.min(axis=1),
            Text(
                "the future is that of the worst action. Which one does the greedy policy take?",
                "l'avenir est celui de la pire action. Laquelle la politique gloutonne choisit-elle ?",
            ),
        ),
        (
            reward + discount * next_q.mean(axis=1),
            Text(
                "the future is the mean over the actions, which belongs to a random policy. Which action does the "
                "greedy one take?",
                "l'avenir est la moyenne sur les actions, celle d'une politique aléatoire. Quelle action la politique "
                "gloutonne choisit-elle ?",
            ),
        ),
        (
            reward + discount * next_q.argmax(axis=1),
            Text(
                "argmax gives the number of the best action. What you need is its value.",
                "argmax donne le numéro de la meilleure action. C'est sa valeur qu'il vous faut.",
            ),
        ),
        (
            reward + discount * next_q.max(),
            Text(
                "the maximum is over the whole batch. Each transition has its own: over which axis is it taken?",
                "le maximum est pris sur tout le lot. Chaque transition a le sien : selon quel axe faut-il le "
                "prendre ?",
            ),
        ),
        (
            discount * (reward + best),
            Text(
                "the reward is discounted as well, and that of a last step is lost. What does the discount multiply?",
                "la récompense est actualisée elle aussi, et celle du dernier pas est perdue. Que multiplie discount ?",
            ),
        ),
        (reward - discount * best, Text("look at the sign of the future.", "regardez le signe de l'avenir.")),
    )
    compiles(student, reward, discount, next_q)


@exercise
def td_errors(student: Any) -> None:
    """Checks ``td_errors(q, action, target)``."""
    q = jnp.array([[1.0, 3.0, 0.0], [4.0, 2.0, 7.0], [5.0, 6.0, 8.0]])
    action, target = jnp.array([0, 1, 2]), jnp.array([2.0, 5.0, 7.0])
    taken = jnp.array([1.0, 2.0, 8.0])
    diagnose(
        numbers(call(student, q, action, target), (3,)),
        target - taken,
        (
            taken - target,
            Text(
                "the sign is reversed. The error must be positive where things went better than the network predicted.",
                "le signe est inversé. L'erreur doit être positive là où les choses se sont mieux passées que le "
                "réseau ne le prévoyait.",
            ),
        ),
        (
            target - q.max(axis=1),
            Text(
                "you compare with the best action. The transition only tells something about the action that was "
                "taken.",
                "vous comparez avec la meilleure action. La transition ne renseigne que sur l'action effectuée.",
            ),
        ),
        (
            target - q[:, 0],
            Text(
                "you always take the first action's value. Where does action come in?",
                "vous prenez toujours la valeur de la première action. Où intervient action ?",
            ),
        ),
        (
            (target - taken) ** 2,
            Text(
                "this is squared already. The square comes in the loss.",
                "l'erreur est déjà au carré. Le carré vient dans la perte.",
            ),
        ),
        (
            jnp.abs(target - taken),
            Text("the sign is lost. Do not take the absolute value.", "le signe est perdu : pas de valeur absolue."),
        ),
    )
    compiles(student, q, action, target)


@exercise
def td_loss(student: Any) -> None:
    """Checks ``td_loss(network, target_network, batch)``: its value, and its gradient with respect to the network."""
    network = jax.tree_util.Partial(_linear, jnp.array([[1.0, -1.0], [0.5, 2.0]]))
    target_network = jax.tree_util.Partial(_linear, jnp.array([[-1.0, 1.5], [2.0, 0.5]]))
    batch = Transition(
        obs=jnp.array([[1.0, 0.0], [0.5, -1.0], [2.0, 1.0]]),
        action=jnp.array([0, 1, 1]),
        reward=jnp.array([1.0, -1.0, 0.5]),
        next_obs=jnp.array([[0.0, 1.0], [1.0, 1.0], [-1.0, 0.5]]),
        discount=jnp.array([0.9, 0.9, 0.0]),
    )

    def error(network: Any, frozen: Any) -> Any:
        taken = jnp.take_along_axis(network(batch.obs), batch.action[:, None], axis=1)[:, 0]
        return batch.reward + batch.discount * frozen(batch.next_obs).max(axis=1) - taken

    result = numbers(call(student, network, target_network, batch), ())
    right = error(network, target_network)
    diagnose(
        result,
        jnp.mean(right**2),
        (
            jnp.mean(error(network, network) ** 2),
            Text(
                "the targets come from the network that is being trained, so they move with every step, and the "
                "gradient may flow through them. Which network stays frozen?",
                "les cibles viennent du réseau en cours d'entraînement : elles bougent à chaque pas, et le gradient "
                "peut les traverser. Quel réseau reste figé ?",
            ),
        ),
        (
            jnp.mean(error(target_network, network) ** 2),
            Text(
                "the two networks are exchanged: which one is trained, and which one gives the targets?",
                "les deux réseaux sont échangés : lequel est entraîné, et lequel donne les cibles ?",
            ),
        ),
        (
            jnp.mean(error(target_network, target_network) ** 2),
            Text(
                "only the target network is used. Which network is to be trained?",
                "seul le réseau cible est utilisé. Quel réseau doit être entraîné ?",
            ),
        ),
        (
            jnp.sum(right**2),
            Text(
                "this is the sum. With the mean, the step size does not depend on the size of the batch.",
                "c'est la somme. Avec la moyenne, la taille du pas ne dépend pas de la taille du lot.",
            ),
        ),
        (
            jnp.mean(right),
            Text(
                "without a square, errors of opposite sign cancel.",
                "sans carré, les erreurs de signes opposés se compensent.",
            ),
        ),
    )
    gradient = call(jax.grad(student), network, target_network, batch).args[0]
    if close(gradient, jnp.zeros((2, 2))):
        raise Wrong(
            "the value is right, but no gradient reaches the network. Is everything inside stop_gradient?",
            "la valeur est juste, mais aucun gradient n'atteint le réseau. Tout est-il dans stop_gradient ?",
        )


def _linear(weight: Any, obs: Any) -> Any:
    return obs @ weight


@exercise
def next_target(student: Any) -> None:
    """Checks ``next_target(target, weight, n_updates, interval)``."""
    target, weight = jnp.array([1.0, 2.0]), jnp.array([3.0, 5.0])
    counts = range(8, 17)
    result = np.stack([numbers(call(student, target, weight, jnp.int32(n), 8), (2,)) for n in counts])
    is_due = np.array([[n % 8 == 0] for n in counts])
    diagnose(
        result,
        np.where(is_due, weight, target),
        (
            np.where(is_due, target, weight),
            Text(
                "it is the wrong way around: the target is copied at every update except those that are due.",
                "c'est l'inverse : la cible est copiée à chaque mise à jour, sauf à celles où elle devrait l'être.",
            ),
        ),
        (
            np.tile(weight, (9, 1)),
            Text(
                "the target is copied at every update: it is never frozen.",
                "la cible est copiée à chaque mise à jour : elle n'est jamais figée.",
            ),
        ),
        (
            np.tile(target, (9, 1)),
            Text(
                "the target never changes. It must follow every interval updates.",
                "la cible ne change jamais. Elle doit suivre toutes les interval mises à jour.",
            ),
        ),
    )
    compiles(student, target, weight, jnp.int32(1), 8)


@exercise
def epsilon(student: Any) -> None:
    """Checks ``epsilon(progress, start, end)``."""
    progress, start, end = np.array([0.0, 0.25, 0.5, 1.0]), 0.8, 0.05
    result = np.stack([numbers(call(student, float(p), start, end), ()) for p in progress])
    diagnose(
        result,
        start * (end / start) ** progress,
        (
            end * (start / end) ** progress,
            Text(
                "it grows: the agent would begin greedy and end at random. When does it know least?",
                "elle croît : l'agent commencerait glouton et finirait au hasard. Quand en sait-il le moins ?",
            ),
        ),
        (
            start + (end - start) * progress,
            Text(
                "both ends are right, but it decreases linearly. The equation multiplies by the same factor in "
                "equal times.",
                "les deux extrémités sont justes, mais la décroissance est linéaire. L'équation multiplie par le "
                "même facteur en des temps égaux.",
            ),
        ),
        (
            start * end**progress,
            Text(
                "it begins at start but does not end at end. What must start be multiplied by?",
                "elle part bien de start, mais n'arrive pas à end. Par quoi faut-il multiplier start ?",
            ),
        ),
        (
            np.full(4, start),
            Text("it does not depend on progress.", "elle ne dépend pas de progress."),
        ),
    )
    compiles(student, 0.5, start, end)


@exercise
def choose(student: Any) -> None:
    """Checks ``choose(q, epsilon, key)``, by counting the actions of many environments."""
    n, share = 30_000, 0.3
    q = jnp.tile(jnp.array([1.0, 5.0, 2.0]), (n, 1))
    result = numbers(call(student, q, share, jax.random.PRNGKey(0)), (n,))
    if not np.isin(result, (0, 1, 2)).all():
        raise Wrong(
            f"actions must be 0, 1 or 2, not {result[~np.isin(result, (0, 1, 2))][0]:g}. Is it a value instead of "
            "its index?",
            f"les actions doivent être 0, 1 ou 2, et non {result[~np.isin(result, (0, 1, 2))][0]:g}. Est-ce une "
            "valeur au lieu de son indice ?",
        )
    shares = np.bincount(result.astype(int), minlength=3) / n
    random, greedy = share / 3, 1 - share
    seen = np.round(shares, 2)
    about = lambda *expected: np.allclose(shares, expected, atol=0.015)  # noqa: E731
    if about(random, greedy + random, random):
        return compiles(student, q, share, jax.random.PRNGKey(0))
    if about((1 - share) / 3, share + (1 - share) / 3, (1 - share) / 3):
        raise Wrong(
            f"with epsilon = {share}, {1 - share:.0%} of the actions are random. In which case is the action random?",
            f"avec epsilon = {share}, {1 - share:.0%} des actions sont aléatoires. Dans quel cas l'action est-elle "
            "aléatoire ?",
        )
    if about(greedy + random, random, random):
        raise Wrong("the greedy action is the worst one.", "l'action gloutonne est la pire.")
    if (shares > 0.999).any():
        raise Wrong(
            "all environments take the same action. Each needs a draw of its own: which shape do the random numbers "
            "have?",
            "tous les environnements font la même action. Chacun a besoin de son propre tirage : quelle forme ont "
            "les nombres aléatoires ?",
        )
    raise Wrong(
        f"with epsilon = {share} and the second action the best, the shares of the actions are {seen}; expected "
        f"about {np.round([random, greedy + random, random], 2)}. Random actions are equally likely; two draws need "
        "two keys.",
        f"avec epsilon = {share} et la deuxième action la meilleure, les fréquences des actions sont {seen} au lieu "
        f"d'environ {np.round([random, greedy + random, random], 2)}. Les actions aléatoires sont équiprobables ; "
        "deux tirages demandent deux clés.",
    )


@exercise
def success_rate(student: Any) -> None:
    """Checks ``success_rate(returns, threshold)``."""
    returns = np.array([-200.0, -150.0, -110.0, -200.0, -90.0, -200.0, -200.0, -120.0, -200.0, -130.0])
    diagnose(
        numbers(call(student, returns, -200.0), ()),
        0.5,
        (
            5.0,
            Text("this is the number of successes, not their share.", "c'est le nombre de succès, et non leur part."),
        ),
        (
            1.0,
            Text(
                "every episode counts as a success, also those at the threshold, in which the time ran out.",
                "chaque épisode compte comme un succès, même ceux qui valent exactement le seuil, où le temps s'est "
                "écoulé.",
            ),
        ),
        (
            50.0,
            Text("this is in percent; return a share from 0 to 1.", "c'est en pour cent ; renvoyez une part de 0 à 1."),
        ),
        (0.0, Text("which episodes are above the threshold?", "quels épisodes sont au-dessus du seuil ?")),
    )


@exercise
def log_prob(student: Any) -> None:
    """Checks ``log_prob(mean, log_std, action)``."""
    mean, log_std = jnp.array([[0.0, 1.0], [0.5, -1.0], [2.0, 0.0]]), jnp.array([[-0.5, 0.3]])
    action = jnp.array([[0.2, 0.4], [0.0, 0.0], [1.0, 1.5]])
    result = call(student, mean, log_std, action)
    z = (action - mean) / jnp.exp(log_std)
    terms = -0.5 * z**2 - log_std - 0.5 * jnp.log(2 * jnp.pi)
    if np.shape(result) == (3, 2):
        raise Wrong(
            "there is one number for each component of the action. The components are independent: what is the "
            "logarithm of the product of their densities?",
            "il y a un nombre par composante de l'action. Les composantes sont indépendantes : quel est le "
            "logarithme du produit de leurs densités ?",
        )
    diagnose(
        numbers(result, (3,)),
        terms.sum(axis=1),
        (
            jnp.exp(terms.sum(axis=1)),
            Text("this is the density; its logarithm is asked for.", "c'est la densité ; il faut son logarithme."),
        ),
        (
            -terms.sum(axis=1),
            Text(
                "the sign is reversed: actions far from the mean would be the most probable.",
                "le signe est inversé : les actions loin de la moyenne seraient les plus probables.",
            ),
        ),
        (
            terms.mean(axis=1),
            Text(
                "this is the mean over the components. The logarithm of a product is a sum.",
                "c'est la moyenne sur les composantes. Le logarithme d'un produit est une somme.",
            ),
        ),
        (
            (terms + log_std).sum(axis=1),
            Text(
                "the term of the standard deviation in front of the exponential is missing: a wide distribution is "
                "lower.",
                "il manque le terme d'écart-type devant l'exponentielle : une distribution large est plus basse.",
            ),
        ),
        (
            (terms + 0.5 * jnp.log(2 * jnp.pi)).sum(axis=1),
            Text("the constant with 2 pi is missing.", "il manque la constante avec 2 pi."),
        ),
        (
            (terms - 0.5 * z**2).sum(axis=1),
            Text("the factor 1/2 of the square is missing.", "il manque le facteur 1/2 du carré."),
        ),
        (
            (-0.5 * ((action - mean) / log_std) ** 2 - log_std - 0.5 * jnp.log(2 * jnp.pi)).sum(axis=1),
            Text(
                "you divide by log_std. How do you get the standard deviation from its logarithm?",
                "vous divisez par log_std. Comment obtient-on l'écart-type à partir de son logarithme ?",
            ),
        ),
    )
    compiles(student, mean, log_std, action)


@exercise
def returns_to_go(student: Any) -> None:
    """Checks ``returns_to_go(rewards, gamma)``."""
    rewards, gamma = np.array([1.0, 2.0, -1.0, 4.0]), 0.5
    powers = gamma ** np.arange(4)
    diagnose(
        numbers(call(student, rewards, gamma), (4,)),
        [2.25, 2.5, 1.0, 4.0],
        (
            [6.0, 5.0, 3.0, 4.0],
            Text("gamma has no effect: this is the plain sum.", "gamma n'a aucun effet : c'est la simple somme."),
        ),
        (
            [1.0, 2.5, 0.25, 4.125],
            Text(
                "you add the past. What can an action at time t still change?",
                "vous ajoutez le passé. Que peut encore changer une action à l'instant t ?",
            ),
        ),
        (
            np.cumsum((rewards * powers)[::-1])[::-1],
            Text(
                "each reward is discounted from the beginning of the episode. At time t, the next reward is one "
                "step away.",
                "chaque récompense est actualisée depuis le début de l'épisode. À l'instant t, la récompense "
                "suivante est à un pas.",
            ),
        ),
        (
            [4.0, 1.0, 2.5, 2.25],
            Text(
                "the values are right, in reverse order.",
                "les valeurs sont justes, mais dans l'ordre inverse.",
            ),
        ),
        (
            [1.25, 0.5, 2.0, 0.0],
            Text(
                "the reward of the step itself is missing.",
                "il manque la récompense du pas lui-même.",
            ),
        ),
    )


@exercise
def advantage(student: Any) -> None:
    """Checks ``advantage(reward, value, next_value, discount, ended, following, gae_lambda)``."""
    reward, value = jnp.array([1.0, 2.0, -1.0]), jnp.array([0.5, 3.0, 1.0])
    next_value, discount = jnp.array([2.0, 1.0, 4.0]), jnp.array([0.9, 0.0, 0.9])
    ended, following, lam = jnp.array([False, True, True]), jnp.array([1.5, -2.0, 3.0]), 0.8
    going = jnp.where(ended, 0.0, discount * lam * following)
    delta = reward + discount * next_value - value
    diagnose(
        numbers(call(student, reward, value, next_value, discount, ended, following, lam), (3,)),
        delta + going,
        (
            going - delta,
            Text(
                "the sign of the TD error is reversed: a step that went better than expected must have a positive "
                "advantage.",
                "le signe de l'erreur TD est inversé : un pas qui s'est mieux passé que prévu doit avoir un "
                "avantage positif.",
            ),
        ),
        (
            delta + discount * lam * following,
            Text(
                "after a truncated episode, the advantage of the next episode's first step is added. Where must the "
                "recursion stop?",
                "après un épisode tronqué, l'avantage du premier pas de l'épisode suivant est ajouté. Où la "
                "récurrence doit-elle s'arrêter ?",
            ),
        ),
        (
            reward + jnp.where(ended, 0.0, discount * next_value) - value + going,
            Text(
                "an episode that was truncated has no future any more. ended stops the recursion, but which of the "
                "factors belongs to the next value?",
                "un épisode tronqué n'a plus d'avenir. ended arrête la récurrence, mais quel facteur multiplie la "
                "valeur suivante ?",
            ),
        ),
        (
            reward + next_value - value + going,
            Text(
                "the next value is not discounted, so that a step that terminated has a future.",
                "la valeur suivante n'est pas actualisée : un pas terminal a ainsi un avenir.",
            ),
        ),
        (
            reward + discount * value - next_value + going,
            Text(
                "value and next_value are exchanged.",
                "value et next_value sont échangées.",
            ),
        ),
        (
            delta + jnp.where(ended, 0.0, lam * following),
            Text(
                "the advantage of the next step is not discounted.",
                "l'avantage du pas suivant n'est pas actualisé.",
            ),
        ),
        (
            delta + jnp.where(ended, 0.0, discount * following),
            Text("where is lambda?", "où est lambda ?"),
        ),
        (
            delta,
            Text(
                "this is the TD error alone. What do the steps after it add?",
                "c'est l'erreur TD seule. Qu'ajoutent les pas qui suivent ?",
            ),
        ),
    )
    compiles(student, reward, value, next_value, discount, ended, following, lam)


@exercise
def ratio(student: Any) -> None:
    """Checks ``ratio(new, old)`` of log-probabilities."""
    new, old = jnp.array([-1.0, -2.0, -0.5]), jnp.array([-1.5, -1.0, -0.25])
    diagnose(
        numbers(call(student, new, old), (3,)),
        jnp.exp(new - old),
        (
            jnp.exp(old - new),
            Text(
                "the ratio is inverted. It must exceed 1 where the new policy makes the action more probable.",
                "le rapport est inversé. Il doit dépasser 1 là où la nouvelle politique rend l'action plus probable.",
            ),
        ),
        (
            new - old,
            Text(
                "this is the logarithm of the ratio. How does one get back to the ratio?",
                "c'est le logarithme du rapport. Comment revenir au rapport ?",
            ),
        ),
        (
            new / old,
            Text(
                "you divide the logarithms. The ratio is that of the probabilities.",
                "vous divisez les logarithmes. Il s'agit du rapport des probabilités.",
            ),
        ),
    )
    compiles(student, new, old)


@exercise
def policy_loss(student: Any) -> None:
    """Checks ``policy_loss(ratio, advantage, clip)``."""
    r, a = jnp.array([0.5, 0.9, 1.6, 1.7, 0.4, 1.1]), jnp.array([2.0, 1.0, 3.0, -1.0, -2.0, -3.0])
    clipped = jnp.clip(r, 0.8, 1.2)
    right = jnp.minimum(r * a, clipped * a)
    diagnose(
        numbers(call(student, r, a, 0.2), ()),
        -right.mean(),
        (
            right.mean(),
            Text(
                "the sign is reversed: the optimizer descends, so it would make good actions less probable.",
                "le signe est inversé : l'optimiseur descend, il rendrait donc les bonnes actions moins probables.",
            ),
        ),
        (
            -jnp.maximum(r * a, clipped * a).mean(),
            Text(
                "this takes the larger of the two terms, which rewards large steps. The bound must be pessimistic.",
                "c'est le plus grand des deux termes, ce qui récompense les grands pas. La borne doit être pessimiste.",
            ),
        ),
        (
            -(r * a).mean(),
            Text(
                "nothing is clipped: the policy may move as far as it likes.",
                "rien n'est écrêté : la politique peut s'éloigner autant qu'elle veut.",
            ),
        ),
        (
            -(clipped * a).mean(),
            Text(
                "only the clipped term is left. Where the ratio has moved to the bad side, no gradient would bring "
                "it back.",
                "il ne reste que le terme écrêté. Là où le rapport est parti du mauvais côté, aucun gradient ne le "
                "ramènerait.",
            ),
        ),
        (
            -jnp.minimum(r * a, r * jnp.clip(a, 0.8, 1.2)).mean(),
            Text(
                "the advantage is clipped. What must not move too far?",
                "c'est l'avantage qui est écrêté. Qu'est-ce qui ne doit pas trop s'éloigner ?",
            ),
        ),
        (
            -jnp.minimum(r * a, jnp.clip(r, -0.2, 0.2) * a).mean(),
            Text(
                "the ratio is clipped around 0. Around which value is it while the policy has not changed?",
                "le rapport est écrêté autour de 0. Que vaut-il tant que la politique n'a pas changé ?",
            ),
        ),
        (
            -jnp.minimum(r * a, jnp.minimum(r, 1.2) * a).mean(),
            Text(
                "the ratio is clipped from above only. What about actions that become less probable?",
                "le rapport n'est écrêté que par le haut. Et les actions qui deviennent moins probables ?",
            ),
        ),
        (
            -jnp.minimum(r * a, jnp.maximum(r, 0.8) * a).mean(),
            Text(
                "the ratio is clipped from below only. What about actions that become more probable?",
                "le rapport n'est écrêté que par le bas. Et les actions qui deviennent plus probables ?",
            ),
        ),
        (-right.sum(), Text("this is the sum, not the mean.", "c'est la somme, et non la moyenne.")),
    )
    compiles(student, r, a, 0.2)


@exercise
def value_loss(student: Any) -> None:
    """Checks ``value_loss(value, target)``, with values ``(n, 1)`` and targets ``(n,)``."""
    value, target = jnp.array([[1.0], [2.0], [4.0]]), jnp.array([2.0, 0.0, 5.0])
    error = value[:, 0] - target
    diagnose(
        numbers(call(student, value, target), ()),
        jnp.mean(error**2),
        (
            jnp.mean((value - target[None]) ** 2),
            Text(
                "values of shape (n, 1) minus targets of shape (n,) have the shape (n, n): each value is compared "
                "with every target. Nothing complains, and the critic learns the mean. Print the shapes.",
                "des valeurs de forme (n, 1) moins des cibles de forme (n,) donnent la forme (n, n) : chaque valeur "
                "est comparée à toutes les cibles. Aucune erreur n'apparaît, et le critique apprend la moyenne. "
                "Affichez les formes.",
            ),
        ),
        (
            -jnp.mean(error**2),
            Text("the sign is reversed: errors would grow.", "le signe est inversé : les erreurs grandiraient."),
        ),
        (
            jnp.mean(error),
            Text(
                "without a square, errors of opposite sign cancel.",
                "sans carré, les erreurs de signes opposés se compensent.",
            ),
        ),
        (jnp.sum(error**2), Text("this is the sum, not the mean.", "c'est la somme, et non la moyenne.")),
    )
    compiles(student, value, target)
