# %% [markdown] lang="en"
# # Course 2: Actor and critic in a box
#
# A ball rolls at random in a box, and an agent that pushes it must keep it inside. The pushes are continuous, so the
# agent cannot compare all of them. It needs two networks: a **critic** that says how good a push is, and an **actor**
# that chooses one.
#
# You write every equation of this algorithm, DDPG ([Lillicrap et al. 2015](https://arxiv.org/abs/1509.02971)), and of
# its noise. Then you put them together and train. After each exercise a check says `OK`, or what it has seen and what
# to think about. In these functions use `jnp` where you would use `np`: JAX computes the derivatives, and `jnp` takes
# NumPy's arrays too.

# %% [markdown] lang="fr"
# # Cours 2 : Acteur et critique dans une boîte
#
# Une bille roule au hasard dans une boîte, et un agent, qui la pousse, doit l'y maintenir. Les poussées sont
# continues : l'agent ne peut pas toutes les comparer. Il lui faut deux réseaux : un **critique**, qui dit ce que vaut
# une poussée, et un **acteur**, qui en choisit une.
#
# Vous allez écrire chaque équation de cet algorithme, DDPG
# ([Lillicrap et al. 2015](https://arxiv.org/abs/1509.02971)), et de son bruit d'exploration. Ensuite vous les
# assemblez et vous entraînez l'agent. Après chaque exercice, une vérification affiche `OK`, ou bien ce qu'elle a
# constaté et à quoi réfléchir. Dans ces fonctions, utilisez `jnp` là où vous écririez `np` : JAX calcule les
# dérivées, et `jnp` accepte aussi les tableaux de NumPy.

# %%
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from types import SimpleNamespace
from typing import Any, ClassVar

import equinox as eqx
import gymnasium as gym
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np
import optax

import rejeu
from rejeu.algorithms.config import OffPolicyConfig
from rejeu.courses import minutes, steps
from rejeu.courses.checks import box as check, require, speak

speak("{language}")

# %% [markdown] lang="en"
# ## 1. The ball
#
# In $n$ dimensions the position is $x \in \mathbb{R}^n$. In one step the agent pushes by $a \in [-2, 2]^n$ and chance
# kicks:
#
# $$x' = x + a + \sigma\,\xi, \qquad \xi \sim \mathcal{N}(0, 1)^n.$$
#
# The reward is 1 for each step that ends inside $[-10, 10]^n$. If the ball leaves, the reward is -10 and the episode
# **terminates**. After 500 steps it is **truncated**: the clock stops the game, the ball could go on.

# %% [markdown] lang="fr"
# ## 1. La bille
#
# En dimension $n$, la position est $x \in \mathbb{R}^n$. À chaque pas, l'agent pousse de $a \in [-2, 2]^n$ et le
# hasard donne un choc :
#
# $$x' = x + a + \sigma\,\xi, \qquad \xi \sim \mathcal{N}(0, 1)^n.$$
#
# La récompense vaut 1 pour chaque pas qui finit dans $[-10, 10]^n$. Si la bille sort, la récompense vaut -10 et
# l'épisode **se termine** (*terminated*). Après 500 pas, il est **tronqué** (*truncated*) : c'est l'horloge qui
# arrête la partie, la bille pourrait continuer.


# %%
def ball_step(position, push, kick):
    """Returns the next position (n,), the reward, and whether the ball has left the box."""  # [en]
    """Renvoie la position suivante (n,), la récompense, et si la bille est sortie de la boîte."""  # [fr]
    # SOLUTION
    # [en] TODO: kick is sigma times the random numbers. Which position decides?
    # [fr] À FAIRE : kick est sigma fois les nombres aléatoires. Quelle position décide ?
    position = position + push + kick
    terminated = bool(np.any(np.abs(position) > 10))
    return position, -10.0 if terminated else 1.0, terminated
    # END


check.ball_step(ball_step)

# %% [markdown] lang="en"
# rejeu has the same ball as an environment, `rejeu/Ball-v0`. The function below plays an episode with any policy; the
# next one draws it: against time in one dimension, as a plane in two, as its first two coordinates and all against
# time in three.

# %% [markdown] lang="fr"
# rejeu fournit la même bille sous forme d'environnement, `rejeu/Ball-v0`. La fonction ci-dessous joue un épisode avec
# une politique quelconque ; la suivante le dessine : en fonction du temps en dimension 1, dans le plan en dimension
# 2 ; en dimension 3, les deux premières coordonnées dans le plan, et toutes en fonction du temps.


# %%
def play(policy, dimension, sigma=1.0, seed=0):
    """Returns the positions of an episode (steps + 1, dimension)."""  # [en]
    """Renvoie les positions d'un épisode (pas + 1, dimension)."""  # [fr]
    env = gym.make("rejeu/Ball-v0", dimension=dimension, sigma=sigma)
    position, _ = env.reset(seed=seed)
    done = False
    while not done:
        position, _, terminated, truncated, _ = env.step(policy(position))
        done = terminated or truncated
    return env.unwrapped.trajectory


def draw(positions, title):
    """Draws the positions of an episode."""  # [en]
    """Dessine les positions d'un épisode."""  # [fr]
    dimension = positions.shape[1]
    panels = {1: ["time"], 2: ["plane"], 3: ["plane", "time"]}[dimension]
    figure, axes = plt.subplots(1, len(panels), figsize=(4.6 * len(panels), 4.2), layout="constrained", squeeze=False)
    for panel, axis in zip(panels, axes[0], strict=True):
        if panel == "plane":
            axis.add_patch(plt.Rectangle((-10, -10), 20, 20, fill=False))
            axis.plot(positions[:, 0], positions[:, 1], ".-", linewidth=0.6, markersize=3, alpha=0.7)
            axis.plot(*positions[0, :2], "o", color="tab:green", label="start")  # [en]
            axis.plot(*positions[0, :2], "o", color="tab:green", label="départ")  # [fr]
            axis.plot(*positions[-1, :2], "s", color="tab:red", label="end")  # [en]
            axis.plot(*positions[-1, :2], "s", color="tab:red", label="fin")  # [fr]
            axis.set(xlabel="$x_1$", ylabel="$x_2$", aspect="equal")
        else:
            axis.plot(positions, linewidth=1, label=[f"$x_{i + 1}$" for i in range(dimension)])
            axis.axhline(-10, color="black")
            axis.axhline(10, color="black")
            axis.set(xlabel="step", ylabel="position")  # [en]
            axis.set(xlabel="pas", ylabel="position")  # [fr]
        axis.legend(loc="upper right")
    figure.suptitle(f"{title} ({len(positions) - 1} steps)")  # [en]
    figure.suptitle(f"{title} ({len(positions) - 1} pas)")  # [fr]
    plt.show()


draw(play(lambda x: 0 * x, dimension=2), "Without any push")  # [en]
draw(play(lambda x: 0 * x, dimension=2), "Sans aucune poussée")  # [fr]
draw(play(lambda x: np.clip(-x, -2, 2), dimension=1), "Towards the center, 1 dimension")  # [en]
draw(play(lambda x: np.clip(-x, -2, 2), dimension=1), "Vers le centre, dimension 1")  # [fr]
draw(play(lambda x: np.clip(-x, -2, 2), dimension=3), "Towards the center, 3 dimensions")  # [en]
draw(play(lambda x: np.clip(-x, -2, 2), dimension=3), "Vers le centre, dimension 3")  # [fr]

# %% [markdown] lang="en"
# ## 2. The Bellman equation
#
# A policy $\mu$ gives the push $\mu(s)$ in the state $s$. Its value is the sum of the rewards to come, each later one
# discounted by $\gamma < 1$. One step of it can be split off: what comes after the first reward is the value of the
# next state. This is the Bellman equation, for the value of starting with any push $a$ and following $\mu$ from then
# on:
#
# $$Q^\mu(s, a) = \mathbb{E}\left[\, r + \gamma\,(1 - d)\; Q^\mu\big(s', \mu(s')\big) \right].$$
#
# $d = 1$ if the episode terminated, else 0. After the end there are no more rewards.
#
# It is an equation for a function that occurs on both sides. So we take any function, compute the right side, the
# **target**, and move the function towards it. The difference is the **TD error** (temporal difference):
#
# $$y = r + \gamma\,(1 - d)\,Q(s', \mu(s')), \qquad \delta = y - Q(s, a).$$

# %% [markdown] lang="fr"
# ## 2. L'équation de Bellman
#
# Une politique $\mu$ donne la poussée $\mu(s)$ dans l'état $s$. Sa valeur est la somme des récompenses à venir,
# chacune actualisée par un facteur $\gamma < 1$ de plus que la précédente. On peut en détacher le premier pas : ce
# qui vient après la première récompense est la valeur de l'état suivant. C'est l'équation de Bellman, écrite pour la
# valeur d'une première poussée $a$ quelconque, suivie de la politique $\mu$ :
#
# $$Q^\mu(s, a) = \mathbb{E}\left[\, r + \gamma\,(1 - d)\; Q^\mu\big(s', \mu(s')\big) \right].$$
#
# On a $d = 1$ si l'épisode se termine, et 0 sinon. Après la fin, il n'y a plus de récompense.
#
# L'inconnue est une fonction, présente des deux côtés. On part donc d'une fonction quelconque, on calcule le membre
# de droite, la **cible**, et on en rapproche la fonction. L'écart est l'**erreur TD** (différence temporelle) :
#
# $$y = r + \gamma\,(1 - d)\,Q(s', \mu(s')), \qquad \delta = y - Q(s, a).$$


# %%
def td_targets(reward, terminated, next_value, gamma):
    """Returns the targets y (n,); next_value (n,) is Q(s', mu(s'))."""  # [en]
    """Renvoie les cibles y (n,) ; next_value (n,) est Q(s', mu(s'))."""  # [fr]
    # SOLUTION return ...
    return reward + gamma * (1 - terminated) * next_value
    # END


def td_error(value, target):
    """Returns the TD errors (n,)."""  # [en]
    """Renvoie les erreurs TD (n,)."""  # [fr]
    # SOLUTION return ...
    return target - value
    # END


check.td_targets(td_targets)
check.td_error(td_error)

# %% [markdown] lang="en"
# Your two functions already solve the equation for the ball in one dimension. We put 81 positions on a grid, let
# chance choose among 41 kicks with $\sigma = 3$, and follow the policy $\mu(x) = \mathrm{clip}(-x, -2, 2)$. Every
# sweep adds the mean TD error to the value of each position, starting from values of 0.

# %% [markdown] lang="fr"
# Vos deux fonctions suffisent déjà à résoudre l'équation pour la bille en dimension 1. Plaçons 81 positions sur une
# grille, donnons au hasard le choix entre 41 chocs, avec $\sigma = 3$, et suivons la politique
# $\mu(x) = \mathrm{clip}(-x, -2, 2)$. Chaque balayage ajoute à la valeur de chaque position l'erreur TD moyenne, en
# partant de valeurs nulles.

# %%
require("ball_step", "td_targets", "td_error")
grid, kicks = np.linspace(-10, 10, 81), 3.0 * np.linspace(-3, 3, 41)
chances = np.exp(-((kicks / 3.0) ** 2) / 2)
chances /= chances.sum()
outcomes = [ball_step(np.array([x]), np.clip(-x, -2, 2), kick) for x in grid for kick in kicks]
next_position = np.array([outcome[0][0] for outcome in outcomes])
reward = np.array([outcome[1] for outcome in outcomes])
terminated = np.array([outcome[2] for outcome in outcomes])

values, gamma = [np.zeros(81)], 0.95
for _ in range(200):
    next_value = np.interp(next_position, grid, values[-1])
    target = np.asarray(td_targets(reward, terminated, next_value, gamma)).reshape(81, 41) @ chances
    values.append(values[-1] + np.asarray(td_error(values[-1], target)))

figure, (left, right) = plt.subplots(1, 2, figsize=(10, 3.8), layout="constrained")
for sweep in (1, 5, 20, 50, 200):
    left.plot(grid, values[sweep], label=f"{sweep} sweeps")  # [en]
    left.plot(grid, values[sweep], label=f"{sweep} balayages")  # [fr]
left.set(xlabel="position", ylabel="value")  # [en]
left.set(xlabel="position", ylabel="valeur")  # [fr]
left.legend()
errors = [np.abs(value - values[-1]).max() for value in values[:150]]
right.semilogy(errors, label="largest error")  # [en]
right.semilogy(errors, label="plus grande erreur")  # [fr]
right.semilogy(errors[0] * gamma ** np.arange(150), "--", label=r"$\gamma^n$")
right.set(xlabel="sweeps")  # [en]
right.set(xlabel="balayages")  # [fr]
right.legend()
plt.show()

# %% [markdown] lang="en"
# **Question.** Each sweep reduces the error at least by the factor $\gamma$, whatever the policy is. Why? And why are
# the values smaller than $1/(1-\gamma) = 20$ even in the center?

# %% [markdown] lang="fr"
# **Question.** Chaque balayage réduit l'erreur au moins d'un facteur $\gamma$, quelle que soit la politique.
# Pourquoi ? Et pourquoi les valeurs sont-elles inférieures à $1/(1-\gamma) = 20$, même au centre ?

# %% [markdown] lang="en" role="answer"
# *Answer.* If two value functions differ by at most $e$, their targets differ by at most $\gamma e$: the rewards are
# the same, the next values are averaged, and $\gamma$ multiplies them. The right side of the equation is a
# contraction, so its only fixed point is reached from everywhere. The value 20 is that of an endless sequence of
# rewards of 1. With $\sigma = 3$ the ball is lost sooner or later from everywhere; the nearer the wall, the sooner.

# %% [markdown] lang="fr" role="answer"
# *Réponse.* Si deux fonctions de valeur diffèrent d'au plus $e$, leurs cibles diffèrent d'au plus $\gamma e$ : les
# récompenses sont les mêmes, les valeurs suivantes sont moyennées, puis multipliées par $\gamma$. Le membre de droite
# est une contraction : son unique point fixe est atteint depuis n'importe quel départ. La valeur 20 est celle d'une
# suite infinie de récompenses égales à 1. Avec $\sigma = 3$, la bille finit par être perdue d'où qu'elle parte, et
# d'autant plus tôt qu'elle est près d'une paroi.

# %% [markdown] lang="en"
# ## 3. Two networks with branches
#
# A grid does not reach far: 81 positions in each of three dimensions are already half a million. Networks take its
# place. In the critic, state and action first pass through layers of their own, their **branches**, and are then
# concatenated, the state first:
#
# ```
# state  -16-32-
#               \
#                -64-64- 1 (linear)
#               /
# action -16-32-
# ```
#
# Layers are pairs of a weight matrix and a bias. All but the last are followed by a ReLU.

# %% [markdown] lang="fr"
# ## 3. Deux réseaux à branches
#
# Une grille ne mène pas loin : 81 positions dans chacune des trois dimensions, c'est déjà un demi-million. Des
# réseaux la remplacent. Dans le critique, l'état et l'action traversent d'abord leurs propres couches, leurs
# **branches**, puis sont concaténés, l'état en premier :
#
# ```
# état   -16-32-
#               \
#                -64-64- 1 (linéaire)
#               /
# action -16-32-
# ```
#
# Une couche est une paire : une matrice de poids et un biais. Toutes, sauf la dernière, sont suivies d'une ReLU.


# %%
def make_layers(key, sizes):
    """Returns layers with random weights, for example make_layers(key, (3, 16, 32))."""  # [en]
    """Renvoie des couches aux poids aléatoires, par exemple make_layers(key, (3, 16, 32))."""  # [fr]
    pairs = list(pairwise(sizes))
    return [
        (jax.random.uniform(k, pair, minval=-1, maxval=1) / pair[0] ** 0.5, jnp.zeros(pair[1]))
        for k, pair in zip(jax.random.split(key, len(pairs)), pairs, strict=True)
    ]


def relu_layers(layers, x):
    """Returns what the layers make of x (n, inputs), with a ReLU after each."""  # [en]
    """Renvoie le résultat des couches sur x (n, entrées), avec une ReLU après chacune."""  # [fr]
    for weight, bias in layers:
        x = jnp.maximum(x @ weight + bias, 0.0)
    return x


def critic(layers, state, action):
    """Returns the values (n, 1); layers has "state", "action", "common" (lists) and "output" (one layer)."""  # [en]
    """Renvoie les valeurs (n, 1) ; layers contient "state", "action", "common" (listes) et "output" (une couche)."""  # [fr]
    # SOLUTION
    # [en] TODO: two branches, jnp.concatenate along axis 1, common layers, and the linear output.
    # [fr] À FAIRE : deux branches, jnp.concatenate sur l'axe 1, les couches communes, et la sortie linéaire.
    branches = [relu_layers(layers["state"], state), relu_layers(layers["action"], action)]
    weight, bias = layers["output"]
    return relu_layers(layers["common"], jnp.concatenate(branches, axis=1)) @ weight + bias
    # END


check.critic(critic)

# %% [markdown] lang="en"
# The actor has the same form without the branch of the action. Its last layer may give any numbers, and the push must
# be within its bounds, its **box**. The hyperbolic tangent takes all numbers to $(-1, 1)$; from there it is a
# straight line to any range.

# %% [markdown] lang="fr"
# L'acteur a la même forme, sans la branche de l'action. Sa dernière couche peut donner des nombres quelconques, alors
# que la poussée doit rester entre ses bornes, dans sa **boîte**. La tangente hyperbolique envoie tous les nombres
# dans $(-1, 1)$ ; de là, une droite mène à n'importe quel intervalle.


# %%
def bounded(output, low, high):
    """Takes any numbers (n, dim) into the range from low to high; 0 is taken to its middle."""  # [en]
    """Envoie des nombres quelconques (n, dim) dans l'intervalle de low à high ; 0 est envoyé au milieu."""  # [fr]
    # SOLUTION
    # [en] TODO: use jnp.tanh, the middle and the half width of the range.
    # [fr] À FAIRE : utiliser jnp.tanh, le milieu et la demi-largeur de l'intervalle.
    return (low + high) / 2 + (high - low) / 2 * jnp.tanh(output)
    # END


def actor(layers, state):
    """Returns the actions (n, dim) in [-1, 1], which rejeu then scales to the range of the environment."""  # [en]
    """Renvoie les actions (n, dim) dans [-1, 1], que rejeu met ensuite à l'échelle de l'environnement."""  # [fr]
    weight, bias = layers["output"]
    hidden = relu_layers(layers["common"], relu_layers(layers["state"], state))
    return bounded(hidden @ weight + bias, -1.0, 1.0)


check.bounded(bounded)

# %% [markdown] lang="en"
# ## 4. Losses and targets
#
# The critic $Q$ is trained as in the grid, except that a gradient step replaces the sweep: over a batch of stored
# steps $(s_i, a_i, r_i, d_i, s_i')$ it minimizes the squared TD error. The actor $\mu$ gets its gradient *through*
# the critic: it is moved in the direction in which the value of its own action rises.
#
# $$L_Q = \frac1n \sum_i \big(Q(s_i, a_i) - y_i\big)^2, \qquad L_\mu = -\frac1n \sum_i Q\big(s_i, \mu(s_i)\big).$$

# %% [markdown] lang="fr"
# ## 4. Pertes et cibles
#
# Le critique $Q$ s'entraîne comme sur la grille, à ceci près qu'un pas de gradient remplace le balayage : sur un lot
# de pas enregistrés $(s_i, a_i, r_i, d_i, s_i')$, il minimise le carré de l'erreur TD. L'acteur $\mu$ reçoit son
# gradient *à travers* le critique : il avance dans la direction où la valeur de sa propre action augmente.
#
# $$L_Q = \frac1n \sum_i \big(Q(s_i, a_i) - y_i\big)^2, \qquad L_\mu = -\frac1n \sum_i Q\big(s_i, \mu(s_i)\big).$$


# %%
def critic_loss(q, state, action, target):
    """Returns the loss of the critic; q(state, action) has the shape (n, 1), target (n,)."""  # [en]
    """Renvoie la perte du critique ; q(state, action) est de forme (n, 1), target de forme (n,)."""  # [fr]
    # SOLUTION return ...
    return jnp.mean(td_error(q(state, action)[:, 0], target) ** 2)
    # END


def actor_loss(mu, q, state):
    """Returns the loss of the actor; mu(state) has the shape (n, dim)."""  # [en]
    """Renvoie la perte de l'acteur ; mu(state) est de forme (n, dim)."""  # [fr]
    # SOLUTION return ...
    return -jnp.mean(q(state, mu(state)))
    # END


check.critic_loss(critic_loss)
check.actor_loss(actor_loss)

# %% [markdown] lang="en"
# The target $y_i$ contains $Q$ itself: the critic chases its own tail. So the targets are computed with copies of
# both networks, the **target networks**, that follow slowly. After each update every weight moves by a small fraction
# $\tau$:
#
# $$w_{\text{target}} \leftarrow (1 - \tau)\, w_{\text{target}} + \tau\, w.$$

# %% [markdown] lang="fr"
# La cible $y_i$ contient $Q$ lui-même : le critique se court après. On calcule donc les cibles avec des copies des
# deux réseaux, les **réseaux cibles**, qui suivent lentement. Après chaque mise à jour, chaque poids avance d'une
# petite fraction $\tau$ :
#
# $$w_{\text{cible}} \leftarrow (1 - \tau)\, w_{\text{cible}} + \tau\, w.$$


# %%
def soft_update(target, online, tau):
    """Returns the new target network; both arguments are trees of arrays."""  # [en]
    """Renvoie le nouveau réseau cible ; les deux arguments sont des arbres de tableaux."""  # [fr]
    # SOLUTION return jax.tree.map(lambda t, o: ..., target, online)
    return jax.tree.map(lambda t, o: (1 - tau) * t + tau * o, target, online)
    # END


check.soft_update(soft_update)

# %% [markdown] lang="en"
# **Question.** What do you expect with $\tau = 1$, and with $\tau = 10^{-6}$?

# %% [markdown] lang="fr"
# **Question.** Qu'attendez-vous de $\tau = 1$, et de $\tau = 10^{-6}$ ?

# %% [markdown] lang="en" role="answer"
# *Answer.* With $\tau = 1$ there is no target network: each update moves the values that the next targets are made
# of, and an overestimated value can lift itself. With $\tau = 10^{-6}$ the targets hardly change: the critic learns
# the first rewards well, and nothing about what comes later, since the information moves back by one step only when
# the target networks have moved. Between the two the training is stable and fast enough; $\tau = 0.005$ is usual.

# %% [markdown] lang="fr" role="answer"
# *Réponse.* Avec $\tau = 1$, il n'y a plus de réseau cible : chaque mise à jour déplace les valeurs dont sont faites
# les cibles suivantes, et une valeur surestimée peut se soulever elle-même. Avec $\tau = 10^{-6}$, les cibles ne
# bougent presque pas : le critique apprend bien les premières récompenses, mais rien de la suite, car l'information
# ne remonte d'un pas que lorsque les réseaux cibles ont bougé. Entre les deux, l'entraînement est stable et assez
# rapide ; $\tau = 0{,}005$ est une valeur courante.

# %% [markdown] lang="en"
# ## 5. Noise that remembers
#
# The actor always gives the same push in the same state. To discover anything, it needs noise. Independent noise at
# each step cancels out over a few steps; a ball, a pendulum or a car hardly notices. The **Ornstein-Uhlenbeck
# process** wanders slowly and is pulled back to 0:
#
# $$dx = -\theta\, x\, dt + \sigma\, dW.$$
#
# In a time step $dt$ the drift acts for the time $dt$. The variance of the random part grows with time, so its
# standard deviation grows with the square root of time.

# %% [markdown] lang="fr"
# ## 5. Un bruit qui a de la mémoire
#
# Dans un même état, l'acteur donne toujours la même poussée. Pour découvrir quoi que ce soit, il lui faut du bruit.
# Un bruit indépendant à chaque pas se compense en quelques pas : une bille, un pendule, une voiture le remarquent à
# peine. Le **processus d'Ornstein-Uhlenbeck** erre lentement et est rappelé vers 0 :
#
# $$dx = -\theta\, x\, dt + \sigma\, dW.$$
#
# Pendant un pas de temps $dt$, la dérive agit durant le temps $dt$. La variance de la partie aléatoire est
# proportionnelle au temps ; son écart type est donc proportionnel à la racine carrée du temps.


# %%
def ou_step(x, normal, theta, sigma, dt):
    """Returns the process after one time step; normal holds standard normal random numbers."""  # [en]
    """Renvoie le processus après un pas de temps ; normal contient des nombres aléatoires normaux centrés réduits."""  # [fr]
    # SOLUTION return ...
    return x - theta * x * dt + sigma * dt**0.5 * normal
    # END


check.ou_step(ou_step)

# %%
require("ou_step")
rng = np.random.default_rng(0)
paths, pushed = np.zeros((1001, 5)), np.zeros((1001, 5))
for t in range(1000):
    normal = rng.normal(size=5)
    paths[t + 1] = ou_step(paths[t], normal, theta=0.15, sigma=0.2, dt=0.01)
    drift = 0.5 * 0.01 if t < 500 else 0.0
    pushed[t + 1] = ou_step(pushed[t], normal, theta=0.15, sigma=0.2, dt=0.01) + drift

figure, axes = plt.subplots(2, 2, figsize=(10, 6), layout="constrained")
(independent, field), (slow, drifting) = axes
independent.plot(0.2 * rng.normal(size=(1000, 5)), linewidth=0.5)
independent.set(title="Independent noise, standard deviation 0.2")  # [en]
independent.set(title="Bruit indépendant, écart type 0,2")  # [fr]
slow.plot(paths, linewidth=1)
slow.set(title="Ornstein-Uhlenbeck", xlabel="step")  # [en]
slow.set(title="Ornstein-Uhlenbeck", xlabel="pas")  # [fr]
x = np.linspace(-2, 2, 2)
for theta in (1, 2, 3):
    field.plot(x, -theta * x, label=rf"$\theta = {theta}$")
field.axhline(0, color="black", linewidth=0.5)
field.set(title=r"Drift $-\theta x$: always towards 0")  # [en]
field.set(title=r"Dérive $-\theta x$ : toujours vers 0")  # [fr]
field.legend()
drifting.plot(pushed, linewidth=1)
drifting.axvline(500, color="black", linewidth=1)
drifting.set(title="Additional drift of 0.5 until step 500", xlabel="step")  # [en]
drifting.set(title="Dérive de 0,5 en plus jusqu'au pas 500", xlabel="pas")  # [fr]
plt.show()

# %% [markdown] lang="en"
# **Question.** After many steps, between which values does the process move? Where does the drift of 0.5 lead in the
# long run?

# %% [markdown] lang="fr"
# **Question.** Après beaucoup de pas, entre quelles valeurs le processus évolue-t-il ? Où la dérive de 0,5
# mène-t-elle à la longue ?

# %% [markdown] lang="en" role="answer"
# *Answer.* In the long run the pull and the kicks balance: the variance $v$ satisfies
# $v = (1 - \theta\,dt)^2 v + \sigma^2 dt$, so $v \approx \sigma^2 / (2\theta)$, a standard deviation of
# $0.2 / \sqrt{0.3} = 0.37$. Its memory lasts about $1/(\theta\,dt) = 667$ steps, which is longer than the figure
# shows the drift for. With the drift $c$ the process moves around the point where $c = \theta x$, here
# $0.5 / 0.15 = 3.3$.

# %% [markdown] lang="fr" role="answer"
# *Réponse.* À la longue, le rappel et les chocs s'équilibrent : la variance $v$ vérifie
# $v = (1 - \theta\,dt)^2 v + \sigma^2 dt$, donc $v \approx \sigma^2 / (2\theta)$, soit un écart type de
# $0{,}2 / \sqrt{0{,}3} = 0{,}37$. La mémoire du processus dure environ $1/(\theta\,dt) = 667$ pas : plus que la durée
# de la dérive sur la figure. Avec une dérive $c$, le processus évolue autour du point où $c = \theta x$, ici
# $0{,}5 / 0{,}15 = 3{,}3$.

# %% [markdown] lang="en"
# ## 6. The repulsive boundary
#
# The action with noise is clipped to the box. During a long excursion of the noise it stays clipped: for hundreds of
# steps the agent tries one single action, the bound. This is called **saturation**. Against it the box gets a soft
# wall, a function that is flat in the middle and steep outside. With the middle $m$ and the half width $h$ of the
# range:
#
# $$B(u) = \left(\frac{\pi}{2}\,\frac{u - m}{h}\right)^6.$$
#
# The action slides down its slope a little, by $g = \text{strength} \cdot B'(u)$, and so does the noise.

# %% [markdown] lang="fr"
# ## 6. La frontière répulsive
#
# L'action bruitée est bornée à la boîte (*clip*). Pendant une longue excursion du bruit, elle reste collée à la
# borne : durant des centaines de pas, l'agent n'essaie qu'une seule action. C'est la **saturation**. Pour l'éviter,
# on donne à la boîte une paroi souple : une fonction plate au milieu et raide au dehors. Avec le milieu $m$ et la
# demi-largeur $h$ de l'intervalle :
#
# $$B(u) = \left(\frac{\pi}{2}\,\frac{u - m}{h}\right)^6.$$
#
# L'action glisse un peu le long de la pente, de $g = \text{force} \cdot B'(u)$, et le bruit aussi.


# %%
def barrier(u, low, high):
    """Returns B(u)."""  # [en]
    """Renvoie B(u)."""  # [fr]
    return (np.pi / 2 * (u - (low + high) / 2) / ((high - low) / 2)) ** 6


def barrier_slope(u, low, high):
    """Returns the derivative of B at u."""  # [en]
    """Renvoie la dérivée de B en u."""  # [fr]
    # SOLUTION return ...
    middle, half = (low + high) / 2, (high - low) / 2
    return 6 * (np.pi / 2 * (u - middle) / half) ** 5 * np.pi / (2 * half)
    # END


check.barrier_slope(barrier_slope)

# %%
require("barrier_slope")
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained")
for axis, (low, high) in zip(axes, [(-1, 1), (-1, 2)], strict=True):
    u = np.linspace(low - 0.1, high + 0.1, 400)
    axis.plot(u, barrier(u, low, high), label="barrier $B$")  # [en]
    axis.plot(u, barrier(u, low, high), label="barrière $B$")  # [fr]
    axis.plot(u, barrier_slope(u, low, high), label="derivative $B'$")  # [en]
    axis.plot(u, barrier_slope(u, low, high), label="dérivée $B'$")  # [fr]
    for bound in (low, high):
        axis.axvline(bound, color="black", linewidth=1)
    axis.set(title=f"Range [{low}, {high}]", xlabel="action with noise $u$")  # [en]
    axis.set(title=f"Intervalle [{low}, {high}]", xlabel="action bruitée $u$")  # [fr]
    axis.legend(loc="upper center")
plt.show()


# %%
def repel(action, x, strength, low, high):
    """Returns the action taken, between its bounds, and the noise after the push."""  # [en]
    """Renvoie l'action choisie, entre ses bornes, et le bruit après la poussée."""  # [fr]
    # SOLUTION
    # [en] TODO: the action with noise, the push g, then jnp.clip. What happens to x?
    # [fr] À FAIRE : l'action bruitée, la poussée g, puis jnp.clip. Que devient x ?
    u = action + x
    push = strength * barrier_slope(u, low, high)
    return jnp.clip(u - push, low, high), x - push
    # END


check.repel(repel)

# %% [markdown] lang="en"
# An actor that always wants 0.8 in the box $[0, 1]$, with the same noise twice:

# %% [markdown] lang="fr"
# Un acteur qui veut toujours 0,8 dans la boîte $[0, 1]$, deux fois avec le même bruit :

# %%
require("ou_step", "repel")
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained", sharey=True)
for axis, strength, name in zip(axes, (0.0, 1e-4), ("$0$", "$10^{-4}$"), strict=True):
    rng, x, taken = np.random.default_rng(1), np.zeros(100), []
    for _ in range(700):
        x = ou_step(x, rng.normal(size=100), theta=0.15, sigma=0.2, dt=0.01)
        action, x = (np.asarray(values) for values in repel(0.8, x, strength, 0.0, 1.0))
        taken.append(action)
    share = np.mean((np.array(taken) <= 0) | (np.array(taken) >= 1))
    axis.plot(np.array(taken)[:, :5], linewidth=1)
    axis.set(title=f"Strength {name}: {share:.0%} of the actions at a bound", xlabel="step")  # [en]
    axis.set(title=f"Force {name} : {100 * share:.0f} % des actions à une borne", xlabel="pas")  # [fr]
axes[0].set(ylabel="action")
plt.show()

# %% [markdown] lang="en"
# **Question.** What happens with a much larger strength, such as 0.05? Try it, and explain it with the slope. And
# what does the boundary cost if the best action is the bound itself?

# %% [markdown] lang="fr"
# **Question.** Que se passe-t-il avec une force bien plus grande, par exemple 0,05 ? Essayez, et expliquez-le par la
# pente. Et que coûte la frontière si la meilleure action est la borne elle-même ?

# %% [markdown] lang="en" role="answer"
# *Answer.* The push is one step of gradient descent on $B$, and the strength is its step size. At the bound the slope
# is $6\,(\pi/2)^5\,\pi/(2h) \approx 180$ for $h = 1/2$. With 0.05 a single push is 9 times as long as the box: the
# action is thrown far out on the other side, where the slope is larger still. The process explodes. (rejeu's own
# noise pushes at most to the middle.) If the bound is the best action, the boundary keeps the agent from trying it;
# then the strength should be small or 0.

# %% [markdown] lang="fr" role="answer"
# *Réponse.* La poussée est un pas de descente de gradient sur $B$, dont la force est la longueur de pas. À la borne,
# la pente vaut $6\,(\pi/2)^5\,\pi/(2h) \approx 180$ pour $h = 1/2$. Avec 0,05, une seule poussée est 9 fois plus
# longue que la boîte : l'action est projetée loin de l'autre côté, où la pente est encore plus forte. Le processus
# explose. (Le bruit fourni par rejeu pousse au plus jusqu'au milieu.) Si la borne est la meilleure action, la
# frontière empêche l'agent de l'essayer ; il faut alors une force faible ou nulle.

# %% [markdown] lang="en"
# ## 7. Everything together
#
# The next cell puts your functions together. rejeu asks of an algorithm for `init`, `explore`, `exploit` and
# `update`, and then takes care of the loop, the replay buffer and the clock. In `update` you find the whole method:
# targets by the target networks, a gradient step of the critic, one of the actor, and the slow target networks. Read
# it; there is nothing to write.

# %% [markdown] lang="fr"
# ## 7. Tout assembler
#
# La cellule suivante assemble vos fonctions. À un algorithme, rejeu demande `init`, `explore`, `exploit` et
# `update` ; il se charge ensuite de la boucle, de la mémoire de rejeu et du chronomètre. Dans `update`, vous
# retrouvez toute la méthode : les cibles par les réseaux cibles, un pas de gradient du critique, un de l'acteur, et
# les réseaux cibles qui suivent lentement. Lisez-la ; il n'y a rien à écrire.


# %%
# [en] Everything that is learned.
# [fr] Tout ce qui est appris.
class Learned(eqx.Module):
    actor: Any
    critic: Any
    target_actor: Any
    target_critic: Any
    actor_moments: Any
    critic_moments: Any


def make(config, observation_space, action_space):
    """Returns the algorithm for these spaces."""  # [en]
    """Renvoie l'algorithme pour ces espaces."""  # [fr]
    n_state, n_action = observation_space.shape[0], action_space.shape[0]
    optimizer = optax.adam(config.learning_rate)

    def init(key):
        keys = jax.random.split(key, 7)
        actor = {"state": make_layers(keys[0], (n_state, 16, 32)), "common": make_layers(keys[1], (32, 64, 64))}
        last = make_layers(keys[2], (64, n_action))[0]
        actor["output"] = jax.tree.map(lambda weight: 0.01 * weight, last)  # [en] far from the flat ends of tanh
        actor["output"] = jax.tree.map(lambda weight: 0.01 * weight, last)  # [fr] loin des extrémités plates de tanh
        critic = {"state": make_layers(keys[3], (n_state, 16, 32)), "action": make_layers(keys[4], (n_action, 16, 32))}
        critic |= {"common": make_layers(keys[5], (64, 64, 64)), "output": make_layers(keys[6], (64, 1))[0]}
        copies = jax.tree.map(jnp.copy, (actor, critic))
        return Learned(actor, critic, *copies, optimizer.init(actor), optimizer.init(critic))

    def update(learned, batch, clock):
        next_action = actor(learned.target_actor, batch.next_obs)
        next_value = critic(learned.target_critic, batch.next_obs, next_action)[:, 0]
        target = td_targets(batch.reward, batch.discount == 0, next_value, config.gamma)

        def loss_of_critic(layers):
            return critic_loss(partial(critic, layers), batch.obs, batch.action, target)

        value, gradient = jax.value_and_grad(loss_of_critic)(learned.critic)
        change, critic_moments = optimizer.update(gradient, learned.critic_moments)
        new_critic = optax.apply_updates(learned.critic, change)

        def loss_of_actor(layers):
            return actor_loss(partial(actor, layers), partial(critic, new_critic), batch.obs)

        gradient = jax.grad(loss_of_actor)(learned.actor)
        change, actor_moments = optimizer.update(gradient, learned.actor_moments)
        new_actor = optax.apply_updates(learned.actor, change)

        targets = soft_update((learned.target_actor, learned.target_critic), (new_actor, new_critic), config.tau)
        metrics = {"critic_loss": value, "q_value": jnp.mean(next_value)}
        return Learned(new_actor, new_critic, *targets, actor_moments, critic_moments), metrics

    return rejeu.Algorithm(
        init,
        actor=lambda learned: learned.actor,
        explore=lambda layers, state, key, clock: actor(layers, state),
        exploit=actor,
        update=update,
        action_values=lambda learned, state, action: critic(learned.critic, state, action)[None, :, 0],
    )


# [en] Hyperparameters: those of every off-policy algorithm.
# [fr] Hyperparamètres : ceux de tout algorithme hors politique.
@dataclass(frozen=True, kw_only=True)
class Settings(OffPolicyConfig):
    name: ClassVar[str] = "BoxDDPG"


# [en] An agent with your algorithm.
# [fr] Un agent doté de votre algorithme.
class BoxDDPG(rejeu.OffPolicyAgent):
    algorithm: ClassVar = SimpleNamespace(Config=Settings, make=make)


# [en] Your noise: ou_step and repel, for actions in [-1, 1].
# [fr] Votre bruit : ou_step et repel, pour des actions dans [-1, 1].
class BoxNoise:
    def __init__(self, dimension, sigma=0.2, strength=1e-4):
        self.dimension, self.sigma, self.strength = dimension, sigma, strength

    def init(self, n_envs):
        return jnp.zeros((n_envs, self.dimension))

    def perturb(self, x, action, key):
        x = ou_step(x, jax.random.normal(key, action.shape), theta=0.15, sigma=self.sigma, dt=0.01)
        taken, x = repel(action, x, self.strength, -1.0, 1.0)
        return x, taken


# %% [markdown] lang="en"
# We train by the clock, as one would in class. The first 600 steps come before the clock starts, because they compile
# your functions. Every 500 steps the agent is evaluated without noise, and the weights of the best evaluation are
# remembered for `restore_best`. You will need them: DDPG may lose again what it has learned.

# %% [markdown] lang="fr"
# L'entraînement se mesure à la montre, comme en classe. Les 600 premiers pas viennent avant le départ du chronomètre,
# car ils compilent vos fonctions. Tous les 500 pas, l'agent est évalué sans bruit, et les poids de la meilleure
# évaluation sont retenus pour `restore_best`. Ils vous serviront : il arrive que DDPG perde ce qu'il a appris.


# %%
def train(env, n_minutes, noise=None, **settings):
    """Returns an agent, trained on one environment for some minutes."""  # [en]
    """Renvoie un agent, entraîné sur un environnement pendant quelques minutes."""  # [fr]
    require(
        "td_targets", "td_error", "critic", "bounded", "critic_loss", "actor_loss", "soft_update", "ou_step", "repel"
    )
    noise = noise or BoxNoise(env.action_space.shape[0])
    settings = {"learning_rate": 1e-3, "batch_size": 64, "learning_starts": 500, "seed": 0} | settings
    agent = BoxDDPG("MlpPolicy", env, action_noise=noise, **settings)
    agent.learn(600)
    evaluate = rejeu.callbacks.Evaluate(gym.make(env.spec), every=500, episodes=5)
    agent.learn(minutes=minutes(n_minutes), callback=evaluate, reset_num_timesteps=False)
    return agent


def draw_history(agent, title):
    """Draws the returns of all episodes and their moving average."""  # [en]
    """Dessine les retours de tous les épisodes et leur moyenne mobile."""  # [fr]
    _, axis = plt.subplots(figsize=(8, 3.6), layout="constrained")
    history = agent.history
    axis.plot(history["seconds"], history["return"], ".", alpha=0.4, label="episodes")  # [en]
    axis.plot(history["seconds"], history["return"], ".", alpha=0.4, label="épisodes")  # [fr]
    axis.plot(history["seconds"], history.moving_average("return", 20), label="mean of 20")  # [en]
    axis.plot(history["seconds"], history.moving_average("return", 20), label="moyenne de 20")  # [fr]
    axis.set(xlabel="seconds", ylabel="return", title=f"{title}: {agent.num_timesteps} steps")  # [en]
    axis.set(xlabel="secondes", ylabel="retour", title=f"{title} : {agent.num_timesteps} pas")  # [fr]
    axis.legend()
    plt.show()


agent = train(gym.make("rejeu/Ball-v0", dimension=2), 0.4)
draw_history(agent, "Ball in 2 dimensions")  # [en]
draw_history(agent, "Bille en dimension 2")  # [fr]
agent.evaluate(episodes=20)

# %%
if agent.best:
    agent.restore_best()
agent.evaluate(minutes=minutes(0.1))

# %% [markdown] lang="en"
# A successful episode returns 549. What has been learned can be drawn: the critic's value of the actor's push at each
# position, and the push itself. Trust it only where the ball has been.

# %% [markdown] lang="fr"
# Un épisode réussi rapporte 549. Ce qui a été appris peut se dessiner : la valeur que le critique attribue à la
# poussée de l'acteur en chaque position, et la poussée elle-même. Ne vous y fiez que là où la bille est passée.

# %%
axis_points = np.linspace(-9.5, 9.5, 15, dtype=np.float32)
positions = np.stack(np.meshgrid(axis_points, axis_points), axis=-1).reshape(-1, 2)
pushes, _ = agent.predict(positions, deterministic=True)
values = agent.q_values(positions, pushes)

figure, axis = plt.subplots(figsize=(5.6, 4.6), layout="constrained")
image = axis.contourf(axis_points, axis_points, values.reshape(15, 15), levels=20)
axis.quiver(*positions.T, *pushes.T, color="white", angles="xy", scale_units="xy", scale=1.5, width=0.004)
axis.set(title="The critic's values and the actor's pushes", xlabel="$x_1$", ylabel="$x_2$", aspect="equal")  # [en]
axis.set(title="Valeurs du critique et poussées de l'acteur", xlabel="$x_1$", ylabel="$x_2$", aspect="equal")  # [fr]
figure.colorbar(image)
plt.show()
draw(play(lambda x: agent.predict(x, deterministic=True)[0], dimension=2), "The trained agent")  # [en]
draw(play(lambda x: agent.predict(x, deterministic=True)[0], dimension=2), "L'agent entraîné")  # [fr]

# %% [markdown] lang="en"
# The same in one and in three dimensions. Look at the lengths of the episodes: if 500 is not reached yet, train
# longer, or with another seed.

# %% [markdown] lang="fr"
# La même chose en dimension 1 et 3. Regardez la longueur des épisodes : si 500 n'est pas encore atteint, entraînez
# plus longtemps, ou avec une autre graine (*seed*).

# %%
for dimension in (1, 3):
    agent = train(gym.make("rejeu/Ball-v0", dimension=dimension), 0.3)
    if agent.best:
        agent.restore_best()
    draw(play(lambda x, agent=agent: agent.predict(x, deterministic=True)[0], dimension), "The trained agent")  # [en]
    draw(play(lambda x, agent=agent: agent.predict(x, deterministic=True)[0], dimension), "L'agent entraîné")  # [fr]
    print(agent.evaluate(episodes=20))

# %% [markdown] lang="en"
# **Question.** The ball is truncated after 500 steps. Why would it be a mistake to treat this like a termination in
# the targets? And why may the best weights of a training be worse than they looked?

# %% [markdown] lang="fr"
# **Question.** La bille est tronquée après 500 pas. Pourquoi serait-ce une erreur de traiter cela dans les cibles
# comme une fin ? Et pourquoi les meilleurs poids d'un entraînement peuvent-ils décevoir ?

# %% [markdown] lang="en" role="answer"
# *Answer.* The state holds the position and not the time. The same position would be worth nothing at step 500 and
# much at step 499; no function of the position can be both. So the critic would learn a mixture. As for the best
# weights: they are the maximum over many noisy numbers, and the maximum is lucky. This is why we evaluate them again,
# on new episodes.

# %% [markdown] lang="fr" role="answer"
# *Réponse.* L'état contient la position, mais pas le temps. La même position ne vaudrait rien au pas 500 et beaucoup
# au pas 499 ; aucune fonction de la position ne peut être les deux à la fois. Le critique apprendrait donc un
# mélange. Quant aux meilleurs poids, ils sont le maximum d'un grand nombre de valeurs bruitées, et un maximum a de la
# chance. C'est pourquoi on les évalue de nouveau, sur d'autres épisodes.

# %% [markdown] lang="en"
# ## 8. Your turn: Pendulum
#
# `Pendulum-v1` is a rod that turns around one end. The observation is $(\cos\alpha, \sin\alpha, \dot\alpha)$, with
# $\alpha = 0$ upright, the action a torque in $[-2, 2]$, too weak to lift the rod at once. After 200 steps the
# episode is truncated. The reward is
#
# $$r = -\left(\alpha^2 + 0.1\,\dot\alpha^2 + 0.001\,a^2\right), \qquad -\pi \le \alpha \le \pi.$$

# %% [markdown] lang="fr"
# ## 8. À vous : Pendulum
#
# `Pendulum-v1` est une tige qui tourne autour d'une extrémité. L'observation est
# $(\cos\alpha, \sin\alpha, \dot\alpha)$, avec $\alpha = 0$ en haut ; l'action est un couple dans $[-2, 2]$, trop
# faible pour soulever la tige d'un coup. Après 200 pas, l'épisode est tronqué. La récompense est
#
# $$r = -\left(\alpha^2 + 0{,}1\,\dot\alpha^2 + 0{,}001\,a^2\right), \qquad -\pi \le \alpha \le \pi.$$


# %%
def pendulum_reward(observation, torque):
    """Returns the reward of a torque in the state that was observed."""  # [en]
    """Renvoie la récompense d'un couple dans l'état observé."""  # [fr]
    # SOLUTION
    # [en] TODO: find the angle with np.arctan2.
    # [fr] À FAIRE : retrouver l'angle avec np.arctan2.
    cosine, sine, speed = observation
    return -(np.arctan2(sine, cosine) ** 2 + 0.1 * speed**2 + 0.001 * torque**2)
    # END


check.pendulum_reward(pendulum_reward)

# %% [markdown] lang="en"
# With your function: a rod under a small constant torque, the rewards that the environment returns (line) and those
# that you compute (dots). They must agree.

# %% [markdown] lang="fr"
# Avec votre fonction : une tige sous un petit couple constant, les récompenses que renvoie l'environnement (ligne) et
# celles que vous calculez (points). Elles doivent coïncider.

# %%
require("pendulum_reward")


def swing(policy, seed):
    """Returns the observations (200, 3), the rewards and your rewards of an episode."""  # [en]
    """Renvoie les observations (200, 3), les récompenses et vos récompenses d'un épisode."""  # [fr]
    env = gym.make("Pendulum-v1")
    observation, _ = env.reset(seed=seed)
    seen, rewards, computed, truncated = [], [], [], False
    while not truncated:
        torque = policy(observation)
        seen.append(observation)
        computed.append(pendulum_reward(observation, torque[0]))
        observation, reward, _, truncated, _ = env.step(torque)
        rewards.append(reward)
    return np.array(seen), np.array(rewards), np.array(computed)


def draw_swing(policy, title, seed=0):
    """Draws the height of the tip and the rewards of an episode."""  # [en]
    """Dessine la hauteur du bout de la tige et les récompenses d'un épisode."""  # [fr]
    seen, rewards, computed = swing(policy, seed)
    _, (left, right) = plt.subplots(1, 2, figsize=(10, 3.2), layout="constrained")
    left.plot(seen[:, 0])
    left.set(title=title, xlabel="step", ylabel="height of the tip", ylim=(-1.05, 1.05))  # [en]
    left.set(title=title, xlabel="pas", ylabel="hauteur du bout", ylim=(-1.05, 1.05))  # [fr]
    right.plot(rewards)
    right.plot(computed, ".", markersize=3)
    right.set(title=f"Rewards, sum {rewards.sum():.0f}", xlabel="step")  # [en]
    right.set(title=f"Récompenses, somme {rewards.sum():.0f}", xlabel="pas")  # [fr]
    plt.show()


draw_swing(lambda observation: np.array([0.1]), "Constant torque of 0.1")  # [en]
draw_swing(lambda observation: np.array([0.1]), "Couple constant de 0,1")  # [fr]

# %% [markdown] lang="en"
# Now train your agent on it. Which noise and how long is up to you; the solution takes 25 seconds.

# %% [markdown] lang="fr"
# Entraînez maintenant votre agent. Le bruit et la durée sont à votre choix ; la solution y consacre 25 secondes.

# %%
# SOLUTION pendulum = ...
# [en] TODO: train(gym.make("Pendulum-v1"), ..., gamma=0.98)
# [fr] À FAIRE : train(gym.make("Pendulum-v1"), ..., gamma=0.98)
pendulum = train(gym.make("Pendulum-v1"), 0.4, noise=BoxNoise(1, sigma=0.4), gamma=0.98, learning_starts=600)
# END
draw_history(pendulum, "Pendulum")
draw_swing(lambda observation: pendulum.predict(observation, deterministic=True)[0], "The trained agent")  # [en]
draw_swing(lambda observation: pendulum.predict(observation, deterministic=True)[0], "L'agent entraîné")  # [fr]
print(pendulum.evaluate(episodes=50))

# %% [markdown] lang="en"
# ## 9. Three open questions
#
# These questions have no single answer. Make an experiment for each, with a figure or a table, and say what it shows
# and what it does not. One run proves little: use at least three seeds before you prefer one method.

# %% [markdown] lang="fr"
# ## 9. Trois questions ouvertes
#
# Ces questions n'ont pas de réponse unique. Faites pour chacune une expérience, avec une figure ou un tableau, et
# dites ce qu'elle montre et ce qu'elle ne montre pas. Un seul essai prouve peu : utilisez au moins trois graines
# (*seeds*) avant de préférer une méthode.

# %% [markdown] lang="en"
# ### 9.1 Noise on the parameters
#
# Noise can be added to the weights of the actor instead of to its actions, once at the start of an episode
# ([Plappert et al. 2017](https://arxiv.org/abs/1706.01905)). How do the actions of an episode then depend on the
# state? How large should the noise be? rejeu has `rejeu.ParameterNoise()`.

# %% [markdown] lang="fr"
# ### 9.1 Du bruit sur les paramètres
#
# Au lieu de bruiter les actions, on peut bruiter les poids de l'acteur, une fois au début de chaque épisode
# ([Plappert et al. 2017](https://arxiv.org/abs/1706.01905)). Comment les actions d'un épisode dépendent-elles alors
# de l'état ? Quelle doit être la taille du bruit ? rejeu fournit `rejeu.ParameterNoise()`.

# %%
# SOLUTION
# [en] TODO: your experiment.
# [fr] À FAIRE : votre expérience.
layers = {"state": make_layers(jax.random.key(0), (1, 16, 32)), "common": make_layers(jax.random.key(1), (32, 64, 64))}
layers["output"] = make_layers(jax.random.key(2), (64, 1))[0]
rng = np.random.default_rng(0)
figure, axes = plt.subplots(1, 2, figsize=(10, 3.6), layout="constrained", sharey=True)
for episode in range(3):
    perturbed = jax.tree.map(lambda w: w + 0.1 * rng.normal(size=w.shape), layers)
    visited = rng.uniform(-10, 10, (200, 1))
    noisy = actor(layers, visited) + 0.1 * rng.normal(size=(200, 1))
    axes[0].plot(visited[:, 0], noisy[:, 0], ".", markersize=3, label=episode + 1)
    axes[1].plot(visited[:, 0], actor(perturbed, visited)[:, 0], ".", markersize=3, label=episode + 1)
axes[0].set(title="Noise on the actions", xlabel="state", ylabel="action")  # [en]
axes[0].set(title="Bruit sur les actions", xlabel="état", ylabel="action")  # [fr]
axes[1].set(title="Noise on the parameters", xlabel="state")  # [en]
axes[1].set(title="Bruit sur les paramètres", xlabel="état")  # [fr]
axes[1].legend(title="episode")  # [en]
axes[1].legend(title="épisode")  # [fr]
plt.show()
with_layer_norm = {"net_arch": [64, 64], "layer_norm": True}
explorer = rejeu.DDPG(
    "MlpPolicy",
    gym.make("rejeu/Ball-v0", dimension=2),
    action_noise=rejeu.ParameterNoise(),
    policy_kwargs=with_layer_norm,
    batch_size=64,
    learning_starts=500,
    seed=0,
)
explorer.learn(steps(8_000))
print(explorer.evaluate(episodes=20))
# END

# %% [markdown] lang="en" role="answer"
# *Answer.* With noise on the actions the same state gets different actions within one episode: a cloud around the
# actor. With noise on the parameters each episode has a policy of its own, a curve: the same state always gets the
# same action. Such an agent tries a whole strategy and not a trembling version of the present one, which helps where
# a reward needs many consistent steps. The right size is not obvious, as the same change of the weights may change
# the actions much or little. The authors measure the change of the *actions* and adapt the size to a target; layer
# norm makes the weights comparable. On this ball one should not expect much of it: chance moves the ball anyway, so
# consistency gains little.

# %% [markdown] lang="fr" role="answer"
# *Réponse.* Avec du bruit sur les actions, un même état reçoit des actions différentes au cours d'un épisode : un
# nuage autour de l'acteur. Avec du bruit sur les paramètres, chaque épisode a sa propre politique, une courbe : un
# même état reçoit toujours la même action. Un tel agent essaie une stratégie entière, et non une version tremblante
# de l'actuelle ; cela aide là où une récompense demande de nombreux pas cohérents. La bonne taille n'est pas
# évidente, car un même changement des poids peut modifier beaucoup ou peu les actions. Les auteurs mesurent le
# changement des *actions* et adaptent la taille à un objectif ; la normalisation de couche (*layer norm*) rend les
# poids comparables. Sur cette bille, il ne faut pas en attendre beaucoup : le hasard la déplace de toute façon, si
# bien que la cohérence y apporte peu.

# %% [markdown] lang="en"
# ### 9.2 An actor with discrete actions
#
# Suppose that the ball knows only the pushes -2, -1, 0, 1 and 2. The derivative of the critic with respect to the
# action is lost. What may the actor output, and what replaces $Q(s, \mu(s))$ in its loss? How does it explore?

# %% [markdown] lang="fr"
# ### 9.2 Un acteur aux actions discrètes
#
# Supposons que la bille ne connaisse que les poussées -2, -1, 0, 1 et 2. La dérivée du critique par rapport à
# l'action est perdue. Que peut donner l'acteur en sortie, et qu'est-ce qui remplace $Q(s, \mu(s))$ dans sa perte ?
# Comment explore-t-il ?


# %%
def discrete_actor_loss(logits, values):
    """Returns the loss of the actor, from its logits (n, n_actions) and the values of all actions (n, n_actions)."""  # [en]
    """Renvoie la perte de l'acteur, d'après ses logits (n, n_actions) et les valeurs de toutes les actions (idem)."""  # [fr]
    # SOLUTION return ...
    return -jnp.mean(jnp.sum(jax.nn.softmax(logits, axis=1) * values, axis=1))
    # END


check.discrete_actor_loss(discrete_actor_loss)

# %% only="solution"
five_pushes = gym.wrappers.TransformAction(
    gym.make("rejeu/Ball-v0", dimension=1),
    lambda action: np.array([action - 2.0], np.float32),
    gym.spaces.Discrete(5),
)
classifier = rejeu.DDPG(
    "MlpPolicy", five_pushes, policy_kwargs={"net_arch": [64, 64]}, batch_size=64, learning_starts=500, seed=0
)
classifier.learn(steps(6_000))
print(classifier.evaluate(episodes=20))
places = np.linspace(-9.5, 9.5, 200, dtype=np.float32)[:, None]
chosen = classifier.predict(places, deterministic=True)[0] - 2
plt.figure(figsize=(6, 3), layout="constrained")
plt.step(places[:, 0], chosen, where="mid")
plt.xlabel("position")
plt.ylabel("push")  # [en]
plt.ylabel("poussée")  # [fr]
plt.show()

# %% [markdown] lang="en" role="answer"
# *Answer.* The actor is a classifier: it outputs logits, and the softmax $\pi(a \mid s)$ of them replaces the single
# action. The critic outputs one value for each action. The value of the policy is then an expectation,
# $\sum_a \pi(a \mid s)\,Q(s, a)$, an exact sum with a derivative: no action is lost. The same expectation replaces
# $Q(s', \mu(s'))$ in the target. The agent explores by drawing its action from $\pi$, so it needs no noise, but it
# must not become certain too early; rejeu adds a small bonus for the entropy of $\pi$ to this end. In the figure you
# see its most probable push at each position.

# %% [markdown] lang="fr" role="answer"
# *Réponse.* L'acteur est un classifieur : il donne des logits, dont la softmax $\pi(a \mid s)$ remplace l'action
# unique. Le critique donne une valeur par action. La valeur de la politique est alors une espérance,
# $\sum_a \pi(a \mid s)\,Q(s, a)$, une somme exacte et dérivable : aucune action n'est perdue. La même espérance
# remplace $Q(s', \mu(s'))$ dans la cible. L'agent explore en tirant son action selon $\pi$ : il n'a pas besoin de
# bruit, mais il ne doit pas devenir certain trop tôt ; rejeu ajoute à cette fin un petit bonus pour l'entropie de
# $\pi$. La figure montre sa poussée la plus probable en chaque position.

# %% [markdown] lang="en"
# ### 9.3 Batch normalization
#
# The inputs of a network may have very different scales. Measure the second coordinate of the ball in centimeters,
# and the first in meters: does your agent still learn? Would batch normalization help? What is its trouble in this
# algorithm, where the critic sees $(s, a)$ from the replay buffer and $(s', \mu(s'))$ in the target?

# %% [markdown] lang="fr"
# ### 9.3 La normalisation par lots
#
# Les entrées d'un réseau peuvent avoir des échelles très différentes. Mesurez la deuxième coordonnée de la bille en
# centimètres et la première en mètres : votre agent apprend-il encore ? La normalisation par lots (*batch
# normalization*) aiderait-elle ? Quelle difficulté pose-t-elle dans cet algorithme, où le critique voit $(s, a)$
# venant de la mémoire, et $(s', \mu(s'))$ dans la cible ?


# %%
def in_centimeters():
    """Returns the ball in 2 dimensions, with the second coordinate times 100."""  # [en]
    """Renvoie la bille en dimension 2, dont la deuxième coordonnée est multipliée par 100."""  # [fr]
    scale = np.array([1.0, 100.0], np.float32)
    space = gym.spaces.Box(-10 * scale, 10 * scale, dtype=np.float32)
    return gym.wrappers.TransformObservation(
        gym.make("rejeu/Ball-v0", dimension=2), lambda position: position * scale, space
    )


# SOLUTION
# [en] TODO: your experiment.
# [fr] À FAIRE : votre expérience.
settings = {"batch_size": 64, "learning_starts": 500, "seed": 0}
noise, small = rejeu.NormalActionNoise([0.0, 0.0], 0.2), {"net_arch": [64, 64]}
agents = {
    "DDPG": rejeu.DDPG("MlpPolicy", in_centimeters(), action_noise=noise, policy_kwargs=small, **settings),
    "DDPG, normalize": rejeu.DDPG(
        "MlpPolicy", in_centimeters(), action_noise=noise, policy_kwargs=small, normalize=True, **settings
    ),
    "CrossQ": rejeu.CrossQ("MlpPolicy", in_centimeters(), policy_kwargs=small, **settings),
}
for name, agent in agents.items():
    agent.learn(steps(6_000))
    print(f"{name:16} {agent.evaluate(episodes=20)}")
# END

# %% [markdown] lang="en" role="answer"
# *Answer.* Normalizing the observations by their running mean and standard deviation (`normalize=True`) puts both
# coordinates on one scale, with the same statistics for actor, critic and targets. Batch normalization does the same
# inside of the network, but by the statistics of the batch. The value of a state then depends on the other states of
# its batch, and it differs between training and acting. In DDPG this is worse than elsewhere: $(s, a)$ comes from old
# policies with noise and $(s', \mu(s'))$ from the present one, so the two passes of the critic have different
# statistics. CrossQ ([Bhatt et al. 2024](https://arxiv.org/abs/1902.05605)) takes the consequence: both batches pass
# through the critic together, so that they share their statistics, and target networks become unnecessary. Layer
# norm, which normalizes each state by itself, has none of these difficulties. The table comes from one seed and a
# short training: it may show that a method fails, and hardly which of two good ones is better.

# %% [markdown] lang="fr" role="answer"
# *Réponse.* Normaliser les observations par leur moyenne et leur écart type courants (`normalize=True`) met les deux
# coordonnées à la même échelle, avec les mêmes statistiques pour l'acteur, le critique et les cibles. La
# normalisation par lots fait de même à l'intérieur du réseau, mais avec les statistiques du lot. La valeur d'un état
# dépend alors des autres états de son lot, et elle diffère entre l'entraînement et le jeu. Dans DDPG, c'est pire
# qu'ailleurs : $(s, a)$ vient d'anciennes politiques bruitées, et $(s', \mu(s'))$ de la politique actuelle ; les deux
# passages dans le critique n'ont donc pas les mêmes statistiques. CrossQ
# ([Bhatt et al. 2024](https://arxiv.org/abs/1902.05605)) en tire la conséquence : les deux lots traversent le
# critique ensemble, si bien qu'ils partagent leurs statistiques, et les réseaux cibles deviennent inutiles. La
# normalisation de couche, qui normalise chaque état séparément, ne connaît aucune de ces difficultés. Le tableau
# vient d'une seule graine et d'un court entraînement : il peut montrer qu'une méthode échoue, mais guère laquelle de
# deux bonnes méthodes est la meilleure.
