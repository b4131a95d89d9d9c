"""Checks of course 2: actor and critic in a box."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from rejeu.courses.checks.base import Text, Wrong, call, close, diagnose, exercise, numbers

SHAPES = {"state": (2, 4), "action": (1, 4), "common": (8, 5)}
"""Inputs and outputs of the layers of a small critic. Both branches have as many outputs, so that their order shows."""


@exercise
def ball_step(student: Any) -> None:
    """Checks ``ball_step(position, push, kick)``."""
    position = np.array([[1.0, -2.0], [9.5, 0.0], [0.0, -9.0], [11.0, 0.0]])
    push = np.array([[0.5, 1.0], [1.0, 0.0], [0.0, -2.0], [-2.0, 0.0]])
    kick = np.array([[-0.2, 0.1], [0.25, 0.0], [0.0, -0.5], [0.0, 0.0]])
    after, results = position + push + kick, [call(student, *case) for case in zip(position, push, kick, strict=True)]
    if not all(isinstance(result, tuple | list) and len(result) == 3 for result in results):
        raise Wrong(
            "three values were expected: the next position, the reward, and whether the episode terminated.",
            "il faut trois valeurs : la position suivante, la récompense, et si l'épisode se termine.",
        )
    diagnose(
        np.stack([numbers(result[0], (2,)) for result in results]),
        after,
        (position + push, Text("the ball moves without the random kick.", "la bille avance sans le choc aléatoire.")),
        (
            position + kick,
            Text("the ball moves without the push of the agent.", "la bille avance sans la poussée de l'agent."),
        ),
        (after - 2 * kick, Text("the kick has the wrong sign.", "le choc aléatoire a le mauvais signe.")),
    )
    lost = (abs(after) > 10).any(axis=1)
    diagnose(
        np.stack([numbers(result[2], ()) for result in results]),
        lost,
        (
            (abs(position) > 10).any(axis=1),
            Text(
                "terminated looks at the position before the step: a ball that leaves is noticed one step too "
                "late. Where is the ball when the environment answers?",
                "terminated examine la position d'avant le pas : une bille qui sort est remarquée un pas trop "
                "tard. Où se trouve la bille quand l'environnement répond ?",
            ),
        ),
        (
            (abs(after) > 10).all(axis=1),
            Text(
                "the ball is lost as soon as one coordinate is outside: any or all?",
                "la bille est perdue dès qu'une seule coordonnée sort : any ou all ?",
            ),
        ),
        (
            (after > 10).any(axis=1),
            Text(
                "a ball that leaves on the negative side is not noticed: use the absolute value.",
                "une bille qui sort du côté négatif n'est pas remarquée : prenez la valeur absolue.",
            ),
        ),
        (~lost, Text("terminated is the wrong way around.", "terminated est inversé.")),
    )
    if not close([numbers(result[1], ()) for result in results], np.where(lost, -10.0, 1.0)):
        raise Wrong(
            "a reward is wrong: it is 1 for a step that ends inside, and -10 for leaving.",
            "une récompense est fausse : elle vaut 1 pour un pas qui finit à l'intérieur, et -10 à la sortie.",
        )


@exercise
def td_targets(student: Any) -> None:
    """Checks ``td_targets(reward, terminated, next_value, gamma)``."""
    reward, next_value, gamma = np.array([1.0, 1.0, -10.0]), np.array([4.0, -2.0, 7.0]), 0.9
    terminated = np.array([False, False, True])
    left = 1.0 - terminated
    diagnose(
        numbers(call(student, reward, terminated, next_value, gamma), (3,)),
        reward + gamma * left * next_value,
        (
            reward + gamma * next_value,
            Text(
                "the ball that left the box still gets a future: the third target is too large. What is the value "
                "of an episode that is over?",
                "la bille sortie de la boîte reçoit encore un avenir : la troisième cible est trop grande. Que "
                "vaut un épisode qui est fini ?",
            ),
        ),
        (
            reward + gamma * terminated * next_value,
            Text(
                "only the step that terminated gets a future. What is terminated while the episode goes on?",
                "seul le pas terminal reçoit un avenir. Que vaut terminated tant que l'épisode continue ?",
            ),
        ),
        (
            left * (reward + gamma * next_value),
            Text(
                "the -10 of the last step has disappeared. Which of the two terms does the end of the episode remove?",
                "le -10 du dernier pas a disparu. Lequel des deux termes la fin de l'épisode supprime-t-elle ?",
            ),
        ),
        (
            reward + left * next_value,
            Text("the discount factor gamma is missing.", "il manque le facteur d'actualisation gamma."),
        ),
        (
            gamma * (reward + left * next_value),
            Text(
                "the reward is discounted as well. It is received now; only what comes later is multiplied by gamma.",
                "la récompense est actualisée, elle aussi. Elle est reçue maintenant ; seule la suite est "
                "multipliée par gamma.",
            ),
        ),
    )


@exercise
def td_error(student: Any) -> None:
    """Checks ``td_error(value, target)``."""
    value, target = np.array([2.0, 0.5, -1.0]), np.array([3.0, -0.5, -1.5])
    diagnose(
        numbers(call(student, value, target), (3,)),
        target - value,
        (
            value - target,
            Text(
                "the sign is reversed. Where the target is larger than the value, the value must rise: value + "
                "error must come closer to the target.",
                "le signe est inversé. Là où la cible dépasse la valeur, la valeur doit monter : valeur + erreur "
                "doit se rapprocher de la cible.",
            ),
        ),
        (
            abs(target - value),
            Text(
                "the error is never negative, so values could only rise. Keep its sign.",
                "l'erreur n'est jamais négative : les valeurs ne pourraient que monter. Gardez son signe.",
            ),
        ),
        (
            (target - value) ** 2,
            Text(
                "this is the squared error, which is the loss. Here the error itself is asked for, with its sign.",
                "c'est l'erreur au carré, donc la perte. On demande ici l'erreur elle-même, avec son signe.",
            ),
        ),
    )


def _relu(layers: list[tuple[np.ndarray, np.ndarray]], x: np.ndarray) -> np.ndarray:
    for weight, bias in layers:
        x = np.maximum(x @ weight + bias, 0.0)
    return x


@exercise
def critic(student: Any) -> None:
    """Checks ``critic(layers, state, action)``."""
    rng = np.random.default_rng(0)
    layers: dict[str, Any] = {
        name: [(rng.normal(size=shape), rng.normal(size=shape[1]))] for name, shape in SHAPES.items()
    }
    layers["output"] = rng.normal(size=(5, 1)), np.array([-1.0])
    state, action = rng.normal(size=(6, 2)), rng.normal(size=(6, 1))
    (weight, bias), s, a = layers["output"], _relu(layers["state"], state), _relu(layers["action"], action)
    joined = _relu(layers["common"], np.concatenate([s, a], axis=1))
    swapped = _relu(layers["common"], np.concatenate([a, s], axis=1))
    diagnose(
        numbers(call(student, layers, state, action), (6, 1)),
        joined @ weight + bias,
        (
            np.maximum(joined @ weight + bias, 0.0),
            Text(
                "the output passes through a ReLU: the critic could never say that a state is bad. Leave the last "
                "layer linear.",
                "la sortie passe par une ReLU : le critique ne pourrait jamais dire qu'un état est mauvais. "
                "Laissez la dernière couche linéaire.",
            ),
        ),
        (
            swapped @ weight + bias,
            Text(
                "the action comes before the state in the concatenation. The figure has the state first.",
                "dans la concaténation, l'action précède l'état. Sur le schéma, l'état vient en premier.",
            ),
        ),
        (
            joined @ weight,
            Text("the bias of the output is missing.", "il manque le biais de la sortie."),
        ),
    )


@exercise
def bounded(student: Any) -> None:
    """Checks ``bounded(output, low, high)``."""
    output, low, high = np.array([[-20.0, 0.0], [0.5, 20.0]]), np.array([-1.0, 0.0]), np.array([3.0, 2.0])
    middle, half = (low + high) / 2, (high - low) / 2
    result = numbers(call(student, output, low, high), (2, 2))
    diagnose(
        result,
        middle + half * np.tanh(output),
        (
            np.clip(output, low, high),
            Text(
                "clip bounds the output, but outside of the range its derivative is 0: the actor could not learn "
                "its way back. Use tanh.",
                "clip borne bien la sortie, mais sa dérivée est nulle hors de l'intervalle : l'acteur ne pourrait "
                "plus apprendre à y revenir. Utilisez tanh.",
            ),
        ),
        (
            high * np.tanh(output),
            Text(
                "the output 0 gives 0, which is the middle only of a range like [-2, 2]. Which number must 0 give "
                "in [-1, 3]?",
                "la sortie 0 donne 0, qui n'est le milieu que d'un intervalle comme [-2, 2]. Que doit donner 0 "
                "dans [-1, 3] ?",
            ),
        ),
        (
            middle + 2 * half * np.tanh(output),
            Text(
                "large outputs leave the range: tanh goes from -1 to 1, which is a length of 2. By how much must "
                "it be multiplied?",
                "les grandes sorties dépassent l'intervalle : tanh va de -1 à 1, soit une longueur de 2. Par "
                "combien faut-il la multiplier ?",
            ),
        ),
        (
            low + 2 * half * np.tanh(output),
            Text(
                "with tanh, which starts at -1, the formula of the sigmoid, which starts at 0, gives actions below "
                "the range.",
                "avec tanh, qui part de -1, la formule de la sigmoïde, qui part de 0, donne des actions sous "
                "l'intervalle.",
            ),
        ),
        (
            middle - half * np.tanh(output),
            Text(
                "large outputs give the lower bound: are low and high swapped?",
                "les grandes sorties donnent la borne inférieure : low et high sont-ils échangés ?",
            ),
        ),
    )


def _value(state: np.ndarray, action: np.ndarray) -> np.ndarray:
    """A critic ``(n, 1)`` whose values rise with the action."""
    return state[:, :1] + 2.0 * action


def _policy(state: np.ndarray) -> np.ndarray:
    return 0.5 * state[:, 1:]


@exercise
def critic_loss(student: Any) -> None:
    """Checks ``critic_loss(q, state, action, target)``."""
    state, action = np.array([[1.0, 0.0], [-1.0, 2.0], [0.5, 1.0]]), np.array([[0.5], [-0.5], [0.25]])
    target = np.array([1.0, -1.5, 3.0])
    error = _value(state, action)[:, 0] - target
    crossed = _value(state, action) - target
    diagnose(
        numbers(call(student, _value, state, action, target), ()),
        (error**2).mean(),
        (
            (crossed**2).mean(),
            Text(
                "q returns a column (n, 1) and the targets are (n,): their difference has the shape (n, n), every "
                "value against every target. Take the column [:, 0] first. This mistake raises no error, and "
                "nothing is learned.",
                "q renvoie une colonne (n, 1) et les cibles sont de forme (n,) : leur différence est de forme (n, "
                "n), chaque valeur contre chaque cible. Prenez d'abord la colonne [:, 0]. Cette faute ne lève "
                "aucune erreur, et rien ne s'apprend.",
            ),
        ),
        (
            (error**2).sum(),
            Text(
                "this is the sum over the batch. The mean does not depend on the size of the batch.",
                "c'est la somme sur le lot. La moyenne, elle, ne dépend pas de la taille du lot.",
            ),
        ),
        (
            error.mean(),
            Text(
                "the errors are not squared: large positive and negative ones cancel.",
                "les erreurs ne sont pas au carré : les grandes erreurs positives et négatives se compensent.",
            ),
        ),
        (
            -error.mean(),
            Text(
                "the errors are not squared: large positive and negative ones cancel.",
                "les erreurs ne sont pas au carré : les grandes erreurs positives et négatives se compensent.",
            ),
        ),
        (
            -(error**2).mean(),
            Text(
                "the sign is reversed: minimizing this would make the errors larger.",
                "le signe est inversé : minimiser cette quantité agrandirait les erreurs.",
            ),
        ),
    )


@exercise
def actor_loss(student: Any) -> None:
    """Checks ``actor_loss(mu, q, state)``."""
    state = np.array([[1.0, 0.5], [-1.0, 2.0], [0.5, 1.0]])
    values = _value(state, _policy(state))[:, 0]
    diagnose(
        numbers(call(student, _policy, _value, state), ()),
        -values.mean(),
        (
            values.mean(),
            Text(
                "the sign is reversed. The optimizer minimizes: with this loss the actor would look for the worst "
                "actions.",
                "le signe est inversé. L'optimiseur minimise : avec cette perte, l'acteur chercherait les pires "
                "actions.",
            ),
        ),
        (
            -values.sum(),
            Text("this is the sum over the batch; take the mean.", "c'est la somme sur le lot ; prenez la moyenne."),
        ),
        (
            -(values**2).mean(),
            Text(
                "the values are squared. The actor maximizes the value itself.",
                "les valeurs sont au carré. L'acteur maximise la valeur elle-même.",
            ),
        ),
        (
            -_policy(state).mean(),
            Text(
                "the critic does not appear: this makes the actions large, not good.",
                "le critique n'apparaît pas : ceci rend les actions grandes, pas bonnes.",
            ),
        ),
    )


@exercise
def soft_update(student: Any) -> None:
    """Checks ``soft_update(target, online, tau)``."""
    target, online, tau = np.array([1.0, -2.0]), np.array([3.0, 4.0]), 0.1
    result = call(student, {"weight": target, "bias": [target * 2]}, {"weight": online, "bias": [online * 2]}, tau)
    if not isinstance(result, dict) or result.keys() != {"weight", "bias"}:
        raise Wrong(
            "the result must be a tree like target. Use jax.tree.map(lambda t, o: ..., target, online).",
            "le résultat doit être un arbre semblable à target. Utilisez jax.tree.map(lambda t, o: ..., target, "
            "online).",
        )
    diagnose(
        numbers(result["weight"], (2,)),
        (1 - tau) * target + tau * online,
        (
            tau * target + (1 - tau) * online,
            Text(
                "tau and 1 - tau are swapped: the target network jumps most of the way at once. With tau = 0 it "
                "should not move.",
                "tau et 1 - tau sont échangés : le réseau cible fait presque tout le chemin d'un coup. Avec tau = "
                "0, il ne devrait pas bouger.",
            ),
        ),
        (
            online,
            Text(
                "this copies the network completely. The target should move by the fraction tau of the way only.",
                "ceci recopie entièrement le réseau. La cible ne doit parcourir que la fraction tau du chemin.",
            ),
        ),
        (
            target + tau * online,
            Text(
                "the old weights are not reduced: the target grows without end. The two factors must add up to 1.",
                "les anciens poids ne sont pas réduits : la cible grandit sans fin. La somme des deux facteurs "
                "doit valoir 1.",
            ),
        ),
        (
            target - tau * (online - target),
            Text(
                "the target moves away from the network: look at the sign.",
                "la cible s'éloigne du réseau : regardez le signe.",
            ),
        ),
    )


@exercise
def ou_step(student: Any) -> None:
    """Checks ``ou_step(x, normal, theta, sigma, dt)``."""
    x, normal, theta, sigma, dt = np.array([2.0, -1.0, 0.0]), np.array([0.0, 1.0, -2.0]), 0.5, 0.3, 0.04
    drift, kick = -theta * x * dt, sigma * math.sqrt(dt) * normal
    no_root = Text(
        "the kick is multiplied by dt. Independent kicks add up by their variances, which are proportional to "
        "time: what does this say about the standard deviation?",
        "le choc est multiplié par dt. Les variances de chocs indépendants s'ajoutent, et sont proportionnelles au "
        "temps : qu'en déduisez-vous pour l'écart type ?",
    )
    without_dt = Text(
        "the kick does not depend on dt: with smaller time steps the noise would become larger. By which power of "
        "dt must it be multiplied?",
        "le choc ne dépend pas de dt : avec des pas de temps plus petits, le bruit deviendrait plus grand. Par "
        "quelle puissance de dt faut-il le multiplier ?",
    )
    diagnose(
        numbers(call(student, x, normal, theta, sigma, dt), (3,)),
        x + drift + kick,
        (
            x - drift + kick,
            Text(
                "the drift has the wrong sign: from x = 2 without a kick the process moves further away, and it "
                "would explode. It must return to 0.",
                "la dérive a le mauvais signe : depuis x = 2, sans choc, le processus s'éloigne encore, et il "
                "exploserait. Il doit revenir vers 0.",
            ),
        ),
        (x + drift + sigma * dt * normal, no_root),
        (x + drift + sigma * normal, without_dt),
        (
            x - theta * x + kick,
            Text(
                "the drift is not multiplied by dt: theta is a rate per unit of time.",
                "la dérive n'est pas multipliée par dt : theta est un taux par unité de temps.",
            ),
        ),
        (
            x + drift,
            Text("there is no noise: the kick is missing.", "il n'y a pas de bruit : il manque le choc."),
        ),
        (
            drift + kick,
            Text(
                "this is the change of the process. Add it to x.",
                "ceci est la variation du processus. Ajoutez-la à x.",
            ),
        ),
        (
            x - theta * dt + kick,
            Text(
                "the drift does not depend on x. The further away the process is, the stronger it is pulled back.",
                "la dérive ne dépend pas de x. Plus le processus est loin, plus il est rappelé fortement.",
            ),
        ),
    )


@exercise
def barrier_slope(student: Any) -> None:
    """Checks ``barrier_slope(u, low, high)``."""
    u, low, high = np.array([-2.0, 0.5, 3.5]), -1.0, 3.0
    half, scaled = 2.0, math.pi / 2 * (np.array([-2.0, 0.5, 3.5]) - 1.0) / 2.0
    right = 6 * scaled**5 * math.pi / (2 * half)
    inner = Text(
        "the inner derivative is missing: what is the derivative of pi/2 (u - m)/h with respect to u?",
        "il manque la dérivée intérieure : quelle est la dérivée de pi/2 (u - m)/h par rapport à u ?",
    )
    diagnose(
        numbers(call(student, u, low, high), (3,)),
        right,
        (6 * scaled**5, inner),
        (
            6 * scaled**5 * math.pi / 2,
            Text(
                "the derivative is that for a half width of 1: where is 1/h of the inner derivative?",
                "cette dérivée est celle d'une demi-largeur de 1 : où est passé le 1/h de la dérivée intérieure ?",
            ),
        ),
        (
            -right,
            Text(
                "this is minus the derivative. The barrier rises to the right of the middle, so its slope is "
                "positive there.",
                "ceci est l'opposé de la dérivée. La barrière monte à droite du milieu : sa pente y est positive.",
            ),
        ),
        (
            abs(right),
            Text(
                "the slope has lost its sign: at the lower bound the push would go the wrong way.",
                "la pente a perdu son signe : à la borne inférieure, la poussée irait dans le mauvais sens.",
            ),
        ),
        (
            scaled**6,
            Text("this is the barrier itself, not its slope.", "ceci est la barrière elle-même, et non sa pente."),
        ),
        (
            6 * (math.pi / 2 * u / half) ** 5 * math.pi / (2 * half),
            Text(
                "the slope is 0 at u = 0. It must be 0 in the middle of the range, here at 1.",
                "la pente est nulle en u = 0. Elle doit l'être au milieu de l'intervalle, ici en 1.",
            ),
        ),
    )


@exercise
def repel(student: Any) -> None:
    """Checks ``repel(action, x, strength, low, high)``."""
    action, x = np.array([2.6, 2.9, 2.0, -0.9]), np.array([1.0, 0.12, 0.9, -0.6])
    strength, low, high = 2e-3, -1.0, 3.0
    u = action + x

    def push(v: np.ndarray) -> np.ndarray:
        return strength * 6 * (math.pi / 4 * (v - 1.0)) ** 5 * math.pi / 4

    result = call(student, action, x, strength, low, high)
    if not isinstance(result, tuple | list) or len(result) != 2:
        raise Wrong(
            "two values were expected: the action taken, and the noise process after the push.",
            "il faut deux valeurs : l'action choisie, et le processus de bruit après la poussée.",
        )
    taken, after = numbers(result[0], (4,)), numbers(result[1], (4,))
    right = np.clip(u - push(u), low, high)
    if close(taken, x - push(u)) and close(after, right):
        raise Wrong("the two results are swapped.", "les deux résultats sont échangés.")
    diagnose(
        taken,
        right,
        (
            np.clip(u + push(u), low, high),
            Text(
                "the action is pushed out instead of in: to go down a slope one subtracts it.",
                "l'action est poussée vers l'extérieur : pour descendre une pente, on la soustrait.",
            ),
        ),
        (
            u - push(u),
            Text(
                "one action is still out of bounds: the push is soft and need not suffice. Clip after it.",
                "une action dépasse encore les bornes : la poussée est douce et peut ne pas suffire. Bornez "
                "l'action (clip) après elle.",
            ),
        ),
        (
            np.clip(u, low, high) - push(np.clip(u, low, high)),
            Text(
                "the action is clipped before the push: all excursions, small or large, are then pushed by the "
                "same amount. Push first.",
                "l'action est bornée avant la poussée : toutes les excursions, petites ou grandes, sont alors "
                "repoussées d'autant. Poussez d'abord.",
            ),
        ),
        (
            np.clip(u, low, high),
            Text(
                "the action is not pushed, only clipped.",
                "l'action n'est pas repoussée, seulement bornée.",
            ),
        ),
    )
    diagnose(
        after,
        x - push(u),
        (
            x,
            Text(
                "the action is pushed and the process is not: it keeps wandering outside, and the next action is "
                "out again. Push x as well.",
                "l'action est repoussée, mais pas le processus : il continue d'errer dehors, et l'action suivante "
                "sortira encore. Repoussez aussi x.",
            ),
        ),
        (
            x + push(u),
            Text(
                "the process is pushed out instead of in: look at the sign.",
                "le processus est poussé vers l'extérieur : regardez le signe.",
            ),
        ),
        (
            right - action,
            Text(
                "the process is clipped together with the action. It should only be pushed: x minus the push.",
                "le processus est borné en même temps que l'action. Il doit seulement être repoussé : x moins la "
                "poussée.",
            ),
        ),
    )


@exercise
def pendulum_reward(student: Any) -> None:
    """Checks ``pendulum_reward(observation, torque)``."""
    angle, speed, torque = 2.5, -3.0, 1.5
    observation = np.array([math.cos(angle), math.sin(angle), speed])
    rest = 0.1 * speed**2 + 0.001 * torque**2
    diagnose(
        numbers(call(student, observation, torque), ()),
        -(angle**2 + rest),
        (
            angle**2 + rest,
            Text(
                "the sign is reversed: this is a cost. The best reward is 0, upright and at rest.",
                "le signe est inversé : ceci est un coût. La meilleure récompense est 0, debout et immobile.",
            ),
        ),
        (
            -((math.pi / 2 - angle) ** 2 + rest),
            Text(
                "the angle is wrong: arctan2 takes the sine first, then the cosine.",
                "l'angle est faux : arctan2 prend d'abord le sinus, puis le cosinus.",
            ),
        ),
        (
            -(math.atan(math.tan(angle)) ** 2 + rest),
            Text(
                "arctan(sin/cos) and arcsin do not distinguish up from down. Which function takes both coordinates?",
                "arctan(sin/cos) et arcsin ne distinguent pas le haut du bas. Quelle fonction prend les deux "
                "coordonnées ?",
            ),
        ),
        (
            -(angle**2 + speed**2 + torque**2),
            Text(
                "the factors 0.1 and 0.001 are missing: speed and torque would matter as much as the angle.",
                "il manque les facteurs 0,1 et 0,001 : la vitesse et le couple compteraient autant que l'angle.",
            ),
        ),
    )


@exercise
def discrete_actor_loss(student: Any) -> None:
    """Checks ``discrete_actor_loss(logits, values)``."""
    logits, values = np.array([[0.0, 1.0, -1.0], [2.0, 0.0, 0.5]]), np.array([[1.0, -2.0, 3.0], [0.5, 4.0, -1.0]])
    probabilities = np.exp(logits) / np.exp(logits).sum(axis=1, keepdims=True)
    right = -(probabilities * values).sum(axis=1).mean()
    diagnose(
        numbers(call(student, logits, values), ()),
        right,
        (
            -right,
            Text(
                "the sign is reversed: the actor would look for the worst actions.",
                "le signe est inversé : l'acteur chercherait les pires actions.",
            ),
        ),
        (
            -(probabilities * values).mean(),
            Text(
                "this is the mean over states and actions. The expectation is the sum over the actions; only then "
                "comes the mean over the batch.",
                "ceci est la moyenne sur les états et les actions. L'espérance est la somme sur les actions ; la "
                "moyenne sur le lot ne vient qu'ensuite.",
            ),
        ),
        (
            -(logits * values).sum(axis=1).mean(),
            Text(
                "the values are weighted with the logits, which may be negative. Turn them into probabilities "
                "(softmax).",
                "les valeurs sont pondérées par les logits, qui peuvent être négatifs. Transformez-les en "
                "probabilités (softmax).",
            ),
        ),
        (
            -values[np.arange(2), logits.argmax(axis=1)].mean(),
            Text(
                "argmax picks one action, and its derivative is 0: the actor would not learn. Use the expectation.",
                "argmax choisit une action, et sa dérivée est nulle : l'acteur n'apprendrait rien. Utilisez "
                "l'espérance.",
            ),
        ),
        (
            -values.mean(axis=1).mean(),
            Text(
                "the logits do not appear: every action counts the same.",
                "les logits n'apparaissent pas : toutes les actions comptent autant.",
            ),
        ),
    )
