# %% [markdown] lang="en"
# # Course 1: DQN and PPO from their parts
#
# In this course you write the parts of two algorithms: **deep Q-learning (DQN)**, which learns how good each action
# is, and **proximal policy optimization (PPO)**, which learns the actions themselves. Your parts are plain functions
# of a few lines in NumPy or JAX. rejeu puts them together and trains with them, fast enough for a laptop: a car
# learns to drive up a mountain, and a lander to land.
#
# - Replace every `...` below a `TODO`. Below it, a line such as `check.td_targets(td_targets)` runs your function on
#   a small case and tells you what it saw.
# - A cell that trains needs the functions above it. If one is missing, it says so and stops.
# - Questions are marked with **Question**. The answers are in the solution, in the folder `solutions`.
#
# You need: `pip install "rejeu[course]"`. All trainings together take about three minutes on two CPU cores.

# %% [markdown] lang="fr"
# # Cours 1 : DQN et PPO, pièce par pièce
#
# Dans ce cours, vous écrivez les pièces de deux algorithmes : le **Q-learning profond (DQN)**, qui apprend ce que
# vaut chaque action, et l'**optimisation proximale de la politique (PPO)**, qui apprend directement les actions. Vos
# pièces sont de simples fonctions de quelques lignes, en NumPy ou en JAX. rejeu les assemble et s'entraîne avec
# elles, assez vite pour un ordinateur portable : une voiture apprend à gravir une montagne, et un module lunaire à se
# poser.
#
# - Remplacez chaque `...` placé sous un `À FAIRE`. Plus bas, une ligne comme `check.td_targets(td_targets)` exécute
#   votre fonction sur un petit cas et vous dit ce qu'elle a observé.
# - Une cellule d'entraînement a besoin des fonctions qui la précèdent. S'il en manque une, elle le dit et s'arrête.
# - Les questions sont signalées par **Question**. Les réponses sont dans le corrigé, dans le dossier `solutions`.
#
# Il vous faut : `pip install "rejeu[course]"`. Tous les entraînements réunis prennent environ trois minutes sur deux
# cœurs.

# %%
from types import SimpleNamespace

import gymnasium as gym
import jax
import jax.numpy as jnp
import matplotlib.pyplot as plt
import numpy as np

import rejeu
from rejeu.algorithms import dqn, optimizers, ppo
from rejeu.callbacks import RecordVideo
from rejeu.core import clip, descend
from rejeu.courses import by_hand, steps
from rejeu.courses.checks import dqn_ppo as check, require, speak
from rejeu.schedules import at

speak("{language}")

# %% [markdown] lang="en"
# ## 1. Play first
#
# Three games, with the keys `a`, `s`, `d`, `w` or the arrows. A window opens. Play a few rounds, so that you know
# what you ask of the agents; `q` closes the window. On a computer without a screen, such as a server, the cells say
# so and go on.
#
# | game | you control | it is a success if |
# |---|---|---|
# | Mountain | the engine of a car, too weak to drive straight up | you reach the flag in time: return above -200 |
# | Lunar | a main engine and two side engines | you land softly on the pad: return of 200 or more |
# | Car | steering, gas and brake | you complete the track: return around 900 |

# %% [markdown] lang="fr"
# ## 1. Jouer d'abord
#
# Trois jeux, avec les touches `a`, `s`, `d`, `w` ou les flèches. Une fenêtre s'ouvre. Jouez quelques parties pour
# savoir ce que vous allez demander aux agents ; `q` ferme la fenêtre. Sur un ordinateur sans écran, un serveur par
# exemple, les cellules le signalent et continuent.
#
# | jeu | vous commandez | c'est un succès si |
# |---|---|---|
# | Mountain | le moteur d'une voiture, trop faible pour la pente | le drapeau est atteint à temps : retour supérieur à -200 |
# | Lunar | un moteur principal et deux moteurs latéraux | vous vous posez en douceur sur la piste : retour de 200 ou plus |
# | Car | le volant, les gaz et le frein | vous faites le tour du circuit : retour voisin de 900 |

# %%
my_scores = {}
for game in ("Mountain", "Lunar", "Car"):
    my_scores[game] = by_hand(game, episodes=3, seed=0)
print(my_scores)

# %% [markdown] lang="en"
# **Question 1.** In Mountain, each step costs -1, wherever the car is. How would an agent that acts at random find
# out that the flag is good?

# %% [markdown] lang="fr"
# **Question 1.** Dans Mountain, chaque pas coûte -1, où que soit la voiture. Comment un agent qui agit au hasard
# découvrirait-il que le drapeau est une bonne chose ?

# %% [markdown] lang="en" role="answer"
# **Answer.** Only by reaching it. Before that, every episode has a return of exactly -200, and no action looks better
# than any other. This is a *sparse* reward: exploration decides whether anything is learned at all.

# %% [markdown] lang="fr" role="answer"
# **Réponse.** Uniquement en l'atteignant. Avant cela, chaque épisode a un retour d'exactement -200, et aucune action
# ne paraît meilleure qu'une autre. C'est une récompense *clairsemée* : c'est l'exploration qui décide si quelque
# chose est appris.

# %% [markdown] lang="en"
# ## 2. Deep Q-learning
#
# At time $t$ the agent sees a state $s_t$, takes an action $a_t$ and gets a reward $r_t$. It wants a large **return**
# $G_t = r_t + \gamma r_{t+1} + \gamma^2 r_{t+2} + \dots$, where $0 < \gamma < 1$ makes the near future count more.
#
# $Q(s, a)$ is the return that one can expect after taking action $a$ in state $s$ and acting as well as possible
# afterwards. Whoever knows $Q$ only needs to look up the best action. $Q$ satisfies the **Bellman equation**:
#
# $$Q(s, a) = \mathbb{E}\left[\, r + \gamma \max_{a'} Q(s', a') \,\right] \tag{1}$$
#
# In words: the value of an action is its reward, plus the discounted value of the best action in the next state. DQN
# makes a neural network satisfy (1), a little more with each gradient step. Four ideas keep this stable; you write
# each of them.

# %% [markdown] lang="fr"
# ## 2. Le Q-learning profond
#
# À l'instant $t$, l'agent observe un état $s_t$, effectue une action $a_t$ et reçoit une récompense $r_t$. Il cherche
# un grand **retour** $G_t = r_t + \gamma r_{t+1} + \gamma^2 r_{t+2} + \dots$, où $0 < \gamma < 1$ donne plus de poids
# à l'avenir proche.
#
# $Q(s, a)$ est le retour espéré quand on effectue l'action $a$ dans l'état $s$, puis que l'on agit au mieux. Qui
# connaît $Q$ n'a plus qu'à y lire la meilleure action. $Q$ vérifie l'**équation de Bellman** :
#
# $$Q(s, a) = \mathbb{E}\left[\, r + \gamma \max_{a'} Q(s', a') \,\right] \tag{1}$$
#
# Autrement dit : la valeur d'une action est sa récompense, plus la valeur actualisée de la meilleure action dans
# l'état suivant. DQN amène un réseau de neurones à vérifier (1), un peu mieux à chaque pas de gradient. Quatre idées
# rendent cela stable ; vous allez écrire chacune d'elles.

# %% [markdown] lang="en"
# ### 2.1 The replay memory
#
# Consecutive steps resemble each other: the car is still where it just was. A network that learns from them in order
# forgets the rest. So the agent stores **transitions** $(s, a, r, s')$ and learns from batches drawn at random. The
# memory has a fixed number of places. When it is full, a new transition takes the place of the oldest one.
#
# **Exercise 1.** Complete `push` and `sample`.

# %% [markdown] lang="fr"
# ### 2.1 La mémoire de rejeu
#
# Des pas consécutifs se ressemblent : la voiture est encore là où elle était. Un réseau qui les apprend dans l'ordre
# oublie le reste. L'agent stocke donc des **transitions** $(s, a, r, s')$ et apprend sur des lots tirés au hasard. La
# mémoire a un nombre de places fixe. Quand elle est pleine, une nouvelle transition prend la place de la plus
# ancienne.
#
# **Exercice 1.** Complétez `push` et `sample`.


# %%
class ReplayMemory:
    def __init__(self, capacity, obs_size):
        self.capacity = capacity
        self.n_pushed = 0  # [en] how many transitions have been pushed so far
        self.n_pushed = 0  # [fr] nombre de transitions ajoutées jusqu'ici
        self.obs = np.zeros((capacity, obs_size), np.float32)
        self.action = np.zeros(capacity, int)
        self.reward = np.zeros(capacity, np.float32)
        self.next_obs = np.zeros((capacity, obs_size), np.float32)
        self.discount = np.zeros(capacity, np.float32)

    def __len__(self):
        return min(self.n_pushed, self.capacity)

    def push(self, obs, action, reward, next_obs, discount):
        # SOLUTION
        # [en] TODO: write the transition to row i of the five arrays. Which i overwrites the oldest one?
        # [fr] À FAIRE : écrire la transition à la ligne i des cinq tableaux. Quel i écrase la plus ancienne ?
        i = self.n_pushed % self.capacity
        self.obs[i], self.action[i], self.reward[i] = obs, action, reward
        self.next_obs[i], self.discount[i] = next_obs, discount
        # END
        self.n_pushed += 1

    def sample(self, batch_size, rng):
        # SOLUTION
        # [en] TODO: draw batch_size rows with rng.integers, and return obs, action, reward, next_obs, discount of these.
        # [fr] À FAIRE : tirer batch_size lignes avec rng.integers, et en renvoyer obs, action, reward, next_obs, discount.
        i = rng.integers(len(self), size=batch_size)
        return self.obs[i], self.action[i], self.reward[i], self.next_obs[i], self.discount[i]
        # END


check.replay_memory(ReplayMemory)

# %% [markdown] lang="en"
# Fill your memory with random actions and compare: to the left 100 steps in order, to the right 100 steps drawn at
# random.

# %% [markdown] lang="fr"
# Remplissez votre mémoire d'actions aléatoires et comparez : à gauche, 100 pas dans l'ordre ; à droite, 100 pas tirés
# au hasard.

# %%
require("replay_memory")
env = gym.make("MountainCar-v0")
env.action_space.seed(0)
memory = ReplayMemory(5000, 2)
obs, _ = env.reset(seed=0)
for _ in range(5000):
    action = env.action_space.sample()
    next_obs, reward, terminated, truncated, _ = env.step(action)
    memory.push(obs, action, reward, next_obs, 0.0 if terminated else 0.99)
    obs = env.reset()[0] if terminated or truncated else next_obs

in_order = memory.obs[1000:1100]
at_random = memory.sample(100, np.random.default_rng(0))[0]
figure, axes = plt.subplots(1, 2, figsize=(9, 3), sharex=True, sharey=True)
for axis, points in zip(axes, (in_order, at_random), strict=True):
    axis.scatter(points[:, 0], points[:, 1], s=12)
    axis.set_xlabel("position")
axes[0].set_ylabel("velocity")  # [en]
axes[0].set_ylabel("vitesse")  # [fr]
axes[0].set_title("in order")  # [en]
axes[0].set_title("dans l'ordre")  # [fr]
axes[1].set_title("drawn at random")  # [en]
axes[1].set_title("tirés au hasard")  # [fr]
plt.show()

# %% [markdown] lang="en"
# ### 2.2 The end of an episode
#
# An episode can end in two ways. It **terminates** when something happened that ends the task: the car is at the
# flag. Nothing can be earned afterwards. It is **truncated** when the clock runs out. Then the car is still on its
# way, and its future is worth as much as before; only we stop watching. The discount of a step says how much its
# future counts:
#
# $$d = \begin{cases} 0 & \text{if the step terminated the episode} \\ \gamma & \text{otherwise} \end{cases} \tag{2}$$
#
# **Exercise 2.** `terminated` and `truncated` are arrays of booleans.

# %% [markdown] lang="fr"
# ### 2.2 La fin d'un épisode
#
# Un épisode peut finir de deux façons. Il est **terminé** quand un événement met fin à la tâche : la voiture est au
# drapeau. Il n'y a plus rien à gagner ensuite. Il est **tronqué** quand le temps imparti est écoulé. La voiture est
# alors encore en route, et son avenir vaut autant qu'avant ; nous cessons seulement de regarder. Le facteur
# d'actualisation d'un pas dit combien compte son avenir :
#
# $$d = \begin{cases} 0 & \text{si le pas a terminé l'épisode} \\ \gamma & \text{sinon} \end{cases} \tag{2}$$
#
# **Exercice 2.** `terminated` et `truncated` sont des tableaux de booléens.


# %%
def discounts(terminated, truncated, gamma):
    # SOLUTION
    # [en] TODO: equation (2).
    # [fr] À FAIRE : l'équation (2).
    return gamma * (1.0 - terminated)
    # END


check.discounts(discounts)

# %% [markdown] lang="en"
# ### 2.3 TD targets and TD errors
#
# Equation (1) becomes a target for the network, the **TD target** (temporal difference):
#
# $$y = r + d \max_{a'} Q(s', a') \tag{3}$$
#
# and the **TD error** says by how much things went better than predicted:
#
# $$\delta = y - Q(s, a) \tag{4}$$
#
# **Exercise 3.** `next_q` has a row for each transition and a column for each action, shape `(n, n_actions)`. The
# result has the shape `(n,)`.

# %% [markdown] lang="fr"
# ### 2.3 Cibles TD et erreurs TD
#
# L'équation (1) donne une cible au réseau, la **cible TD** (différence temporelle) :
#
# $$y = r + d \max_{a'} Q(s', a') \tag{3}$$
#
# et l'**erreur TD** dit de combien les choses se sont mieux passées que prévu :
#
# $$\delta = y - Q(s, a) \tag{4}$$
#
# **Exercice 3.** `next_q` a une ligne par transition et une colonne par action, forme `(n, n_actions)`. Le résultat
# est de forme `(n,)`.


# %%
def td_targets(reward, discount, next_q):
    # SOLUTION
    # [en] TODO: equation (3).
    # [fr] À FAIRE : l'équation (3).
    return reward + discount * jnp.max(next_q, axis=1)
    # END


check.td_targets(td_targets)

# %% [markdown] lang="en"
# **Exercise 4.** `q` has the shape `(n, n_actions)`. `jnp.take_along_axis(q, index, axis=1)` picks one entry of each
# row, if `index` has the shape `(n, 1)`.

# %% [markdown] lang="fr"
# **Exercice 4.** `q` est de forme `(n, n_actions)`. `jnp.take_along_axis(q, index, axis=1)` prend un élément par
# ligne, si `index` est de forme `(n, 1)`.


# %%
def td_errors(q, action, target):
    # SOLUTION
    # [en] TODO: equation (4), with the value of the action that was taken. Watch the shapes.
    # [fr] À FAIRE : l'équation (4), avec la valeur de l'action effectuée. Attention aux formes.
    taken = jnp.take_along_axis(q, action[:, None], axis=1)[:, 0]
    return target - taken
    # END


check.td_errors(td_errors)

# %% [markdown] lang="en"
# ### 2.4 The target network
#
# The target (3) contains the network itself. If it moves with every step, the network chases its own tail. So a copy
# is kept, the **target network** $Q'$. It gives the targets and is frozen. Every `interval` updates it becomes a
# fresh copy. The loss is
#
# $$L = \frac{1}{n} \sum_{i=1}^{n} \left( r_i + d_i \max_{a'} Q'(s'_i, a') - Q(s_i, a_i) \right)^2 \tag{5}$$
#
# **Exercise 5.** `network(obs)` returns the values of all actions. `batch` has the fields `obs`, `action`, `reward`,
# `next_obs` and `discount`. Use your functions.

# %% [markdown] lang="fr"
# ### 2.4 Le réseau cible
#
# La cible (3) contient le réseau lui-même. Si elle bouge à chaque pas, le réseau court après sa propre queue. On
# garde donc une copie, le **réseau cible** $Q'$. C'est lui qui donne les cibles, et il est figé. Toutes les
# `interval` mises à jour, on en refait une copie. La perte est
#
# $$L = \frac{1}{n} \sum_{i=1}^{n} \left( r_i + d_i \max_{a'} Q'(s'_i, a') - Q(s_i, a_i) \right)^2 \tag{5}$$
#
# **Exercice 5.** `network(obs)` renvoie les valeurs de toutes les actions. `batch` a les champs `obs`, `action`,
# `reward`, `next_obs` et `discount`. Utilisez vos fonctions.


# %%
def td_loss(network, target_network, batch):
    # SOLUTION
    # [en] TODO: equation (5). Which network gives the targets?
    # [fr] À FAIRE : l'équation (5). Quel réseau donne les cibles ?
    target = td_targets(batch.reward, batch.discount, target_network(batch.next_obs))
    return jnp.mean(td_errors(network(batch.obs), batch.action, target) ** 2)
    # END


check.td_loss(td_loss)

# %% [markdown] lang="en"
# **Exercise 6.** `target` and `weight` are arrays of weights, of the target network and of the network. At the update
# number 0, `interval`, 2 `interval`, ... the target becomes `weight`, else it stays. `n_updates` is an array of JAX,
# so `if` does not work; use `jnp.where(condition, a, b)`.

# %% [markdown] lang="fr"
# **Exercice 6.** `target` et `weight` sont des tableaux de poids, ceux du réseau cible et ceux du réseau. Aux mises à
# jour de numéro 0, `interval`, 2 `interval`, ... la cible devient `weight`, sinon elle ne change pas. `n_updates` est
# un tableau JAX, donc `if` ne fonctionne pas ; utilisez `jnp.where(condition, a, b)`.


# %%
def next_target(target, weight, n_updates, interval):
    # SOLUTION
    # [en] TODO: return target or weight.
    # [fr] À FAIRE : renvoyer target ou weight.
    return jnp.where(n_updates % interval == 0, weight, target)
    # END


check.next_target(next_target)

# %% [markdown] lang="en"
# ### 2.5 Exploration with epsilon
#
# An agent that always takes the best known action never finds a better one. With probability $\varepsilon$ it acts at
# random. At the beginning it knows nothing, so $\varepsilon$ starts large and shrinks. With $p$ from 0 (beginning) to
# 1 (end of training):
#
# $$\varepsilon(p) = \varepsilon_0 \left( \frac{\varepsilon_1}{\varepsilon_0} \right)^{p} \tag{6}$$
#
# **Exercise 7.** Here `start` is $\varepsilon_0$ and `end` is $\varepsilon_1$.

# %% [markdown] lang="fr"
# ### 2.5 L'exploration avec epsilon
#
# Un agent qui choisit toujours la meilleure action connue n'en trouve jamais de meilleure. Avec une probabilité
# $\varepsilon$, il agit au hasard. Au début il ne sait rien : $\varepsilon$ part donc d'une grande valeur et diminue.
# Avec $p$ allant de 0 (début) à 1 (fin de l'entraînement) :
#
# $$\varepsilon(p) = \varepsilon_0 \left( \frac{\varepsilon_1}{\varepsilon_0} \right)^{p} \tag{6}$$
#
# **Exercice 7.** Ici, `start` est $\varepsilon_0$ et `end` est $\varepsilon_1$.


# %%
def epsilon(progress, start, end):
    # SOLUTION
    # [en] TODO: equation (6).
    # [fr] À FAIRE : l'équation (6).
    return start * (end / start) ** progress
    # END


check.epsilon(epsilon)

# %%
require("epsilon")
progress = np.linspace(0, 1, 101)
plt.figure(figsize=(6, 2.5))
plt.plot(progress, [epsilon(p, 0.9, 0.01) for p in progress])
plt.xlabel("progress of training")  # [en]
plt.xlabel("avancement de l'entraînement")  # [fr]
plt.ylabel("epsilon")
plt.show()

# %% [markdown] lang="en"
# **Exercise 8.** `q` has a row for each environment: `(n, n_actions)`. Return one action for each, `(n,)`. In JAX,
# random numbers come from keys: `jax.random.uniform(key, shape)` and `jax.random.randint(key, shape, low, high)`. Two
# draws need two keys: `key_a, key_b = jax.random.split(key)`.

# %% [markdown] lang="fr"
# **Exercice 8.** `q` a une ligne par environnement : `(n, n_actions)`. Renvoyez une action pour chacun, `(n,)`. En
# JAX, les nombres aléatoires viennent de clés : `jax.random.uniform(key, shape)` et
# `jax.random.randint(key, shape, low, high)`. Deux tirages demandent deux clés :
# `key_a, key_b = jax.random.split(key)`.


# %%
def choose(q, epsilon, key):
    # SOLUTION
    # [en] TODO: with probability epsilon a random action, else the best one.
    # [fr] À FAIRE : avec une probabilité epsilon une action aléatoire, sinon la meilleure.
    whether_key, which_key = jax.random.split(key)
    n, n_actions = q.shape
    random_action = jax.random.randint(which_key, (n,), 0, n_actions)
    is_random = jax.random.uniform(whether_key, (n,)) < epsilon
    return jnp.where(is_random, random_action, jnp.argmax(q, axis=1))
    # END


check.choose(choose)

# %% [markdown] lang="en"
# ### 2.6 Training
#
# rejeu describes an algorithm by a few pure functions. We take those of its DQN and replace `explore` and `update` by
# yours. The networks, the memory, the loop and the environments are rejeu's, compiled and fast. Read the cell: it is
# all of DQN.

# %% [markdown] lang="fr"
# ### 2.6 L'entraînement
#
# rejeu décrit un algorithme par quelques fonctions pures. Nous prenons celles de son DQN et remplaçons `explore` et
# `update` par les vôtres. Les réseaux, la mémoire, la boucle et les environnements sont ceux de rejeu, compilés et
# rapides. Lisez la cellule : c'est tout DQN.

# %%
require("td_targets", "td_errors", "td_loss", "next_target", "epsilon", "choose")


def make_dqn(config, observation_space, action_space):
    parts = dqn.make(config, observation_space, action_space)
    optimizer = optimizers.make(config.optimizer)

    def explore(network, obs, key, clock):
        share = epsilon(clock.progress, config.exploration_initial_eps, config.exploration_final_eps)
        return choose(network(obs), share, key)

    def update(state, batch, clock):
        target_network = jax.tree.map(
            lambda target, weight: next_target(target, weight, state.n_updates, config.target_update_interval),
            state.target_network,
            state.network,
        )
        loss, gradient = jax.value_and_grad(td_loss)(state.network, target_network, batch)
        gradient = clip(gradient, config.clip_grad_value, None)
        network, moments = descend(state.network, gradient, state.optimizer, optimizer, config.learning_rate)
        return dqn.State(network, target_network, moments, jnp.uint32(clock.step), state.n_updates + 1), {"loss": loss}

    return parts._replace(explore=explore, update=update)


class MyDQN(rejeu.OffPolicyAgent):
    algorithm = SimpleNamespace(Config=dqn.Config, make=make_dqn)


# %% [markdown] lang="en"
# 450 episodes of at most 200 steps. One departure from section 2.2, which question 2 asks about:
# `TimeLimitTerminates` makes the time limit a termination. Every 90 episodes the callback `RecordVideo` records the
# policy, without random actions.

# %% [markdown] lang="fr"
# 450 épisodes de 200 pas au plus. Une entorse à la section 2.2, sur laquelle porte la question 2 :
# `TimeLimitTerminates` fait de la limite de temps une terminaison. Tous les 90 épisodes, la fonction de rappel
# `RecordVideo` filme la politique, sans actions aléatoires.

# %%
car = MyDQN(
    "MlpPolicy",
    rejeu.TimeLimitTerminates(gym.make("MountainCar-v0")),
    learning_rate=3e-4,
    gamma=0.99,
    buffer_size=10_000,
    batch_size=128,
    learning_starts=128,
    train_freq=1,
    gradient_steps=1,
    target_update_interval=10,
    exploration_initial_eps=0.9,
    exploration_final_eps=0.01,
    clip_grad_value=100.0,
    policy_kwargs={"net_arch": [128, 128]},
    seed=0,
)
every = RecordVideo("videos/car", every_episodes=steps(90), env="MountainCar-v0", seed=0)
car.learn(episodes=steps(450), callback=every)
print(car.history)

# %%
car.history.plot()

# %%
rejeu.show_videos("videos/car")

# %% [markdown] lang="en"
# ### 2.7 Counting successes
#
# An episode of MountainCar is a success if its return is **above** -200: the flag was reached before the time was up.
#
# **Exercise 9.** Return the share of the successes, from 0 to 1.

# %% [markdown] lang="fr"
# ### 2.7 Compter les succès
#
# Un épisode de MountainCar est un succès si son retour est **supérieur** à -200 : le drapeau a été atteint avant la
# fin du temps.
#
# **Exercice 9.** Renvoyez la part des succès, de 0 à 1.


# %%
def success_rate(returns, threshold):
    # SOLUTION
    # [en] TODO: the share of returns above threshold.
    # [fr] À FAIRE : la part des retours supérieurs à threshold.
    return np.mean(returns > threshold)
    # END


check.success_rate(success_rate)


# %%
require("success_rate")


def statistics(title, returns, lengths, threshold):
    if len(returns) == 0:
        return
    print(
        f"{title:24} {len(returns):5}   {np.mean(returns):8.1f} ± {np.std(returns):6.1f} {np.mean(lengths):8.1f} "
        f"{success_rate(returns, threshold):8.0%}"
    )


def random_episodes(env_id, episodes):
    """Returns the returns and lengths of episodes with random actions."""  # [en]
    """Renvoie les retours et les longueurs d'épisodes aux actions aléatoires."""  # [fr]
    env, returns, lengths = gym.make(env_id), [], []
    env.action_space.seed(0)
    for episode in range(episodes):
        env.reset(seed=episode)
        total, length, done = 0.0, 0, False
        while not done:
            _, reward, terminated, truncated, _ = env.step(env.action_space.sample())
            total, length, done = total + reward, length + 1, terminated or truncated
        returns.append(total)
        lengths.append(length)
    return np.array(returns), np.array(lengths)


HEADER = f"{'MountainCar':24} {'n':>5}   {'return':>8}   {'std':>6} {'length':>8} {'success':>8}"  # [en]
HEADER = f"{'MountainCar':24} {'n':>5}   {'retour':>8}   {'écart':>6} {'longueur':>8} {'succès':>8}"  # [fr]
print(HEADER)
statistics("random", *random_episodes("MountainCar-v0", 50), -200)  # [en]
statistics("au hasard", *random_episodes("MountainCar-v0", 50), -200)  # [fr]
returns, lengths = car.history["return"], car.history["length"]
statistics("training, first 100", returns[:100], lengths[:100], -200)  # [en]
statistics("entraînement, 100 prem.", returns[:100], lengths[:100], -200)  # [fr]
statistics("training, last 100", returns[-100:], lengths[-100:], -200)  # [en]
statistics("entraînement, 100 dern.", returns[-100:], lengths[-100:], -200)  # [fr]
greedy = car.evaluate(episodes=50, env="MountainCar-v0", seed=1)
statistics("greedy, new episodes", greedy.returns, greedy.lengths, -200)  # [en]
statistics("glouton, autres épisodes", greedy.returns, greedy.lengths, -200)  # [fr]
if car.best is not None:
    car.restore_best()
    greedy = car.evaluate(episodes=50, env="MountainCar-v0", seed=1)
    statistics("the same, best weights", greedy.returns, greedy.lengths, -200)  # [en]
    statistics("idem, meilleurs poids", greedy.returns, greedy.lengths, -200)  # [fr]
statistics("you", np.array(my_scores["Mountain"]), np.array([np.nan]), -200)  # [en]
statistics("vous", np.array(my_scores["Mountain"]), np.array([np.nan]), -200)  # [fr]

# %% [markdown] lang="en"
# While training, rejeu keeps the weights with the best mean return over 20 episodes. `restore_best` takes them back: the
# last weights of DQN are not always its best ones.
#
# What has the network learned? To the left the value of the best action, to the right that action, for every position
# and velocity. Mostly it pushes in the direction in which the car is moving, as on a swing.

# %% [markdown] lang="fr"
# Pendant l'entraînement, rejeu garde les poids dont le retour moyen sur 20 épisodes est le meilleur. `restore_best` les
# reprend : les derniers poids de DQN ne sont pas toujours les meilleurs.
#
# Qu'a appris le réseau ? À gauche la valeur de la meilleure action, à droite cette action, pour chaque position et
# chaque vitesse. Le plus souvent, il pousse dans le sens du mouvement, comme sur une balançoire.

# %%
position, velocity = np.meshgrid(np.linspace(-1.2, 0.6, 80), np.linspace(-0.07, 0.07, 80))
q = car.q_values(np.stack([position.ravel(), velocity.ravel()], axis=1).astype(np.float32))
figure, axes = plt.subplots(1, 2, figsize=(10, 3.5), sharey=True)
value = axes[0].pcolormesh(position, velocity, q.max(axis=1).reshape(80, 80))
figure.colorbar(value, ax=axes[0])
axes[0].set_title("max Q")
action = axes[1].pcolormesh(position, velocity, q.argmax(axis=1).reshape(80, 80), cmap="coolwarm", vmin=0, vmax=2)
bar = figure.colorbar(action, ax=axes[1], ticks=[0, 1, 2])
bar.ax.set_yticklabels(["left", "none", "right"])  # [en]
bar.ax.set_yticklabels(["gauche", "rien", "droite"])  # [fr]
axes[1].set_title("argmax Q")
axes[0].set_ylabel("velocity")  # [en]
axes[0].set_ylabel("vitesse")  # [fr]
for axis in axes:
    axis.set_xlabel("position")
plt.show()

# %% [markdown] lang="en"
# **Question 2.** The time limit counts as a termination here, although section 2.2 explains why that is wrong. Train
# once without `TimeLimitTerminates`. What happens, and why may the wrong target help here?
#
# **Question 3.** Set `target_update_interval=1`, then 1000. What do you expect, and what do you see?

# %% [markdown] lang="fr"
# **Question 2.** Ici, la limite de temps compte comme une terminaison, bien que la section 2.2 explique pourquoi
# c'est faux. Entraînez une fois sans `TimeLimitTerminates`. Que se passe-t-il, et pourquoi la cible fausse peut-elle
# aider ici ?
#
# **Question 3.** Réglez `target_update_interval=1`, puis 1000. À quoi vous attendez-vous, et que voyez-vous ?

# %% [markdown] lang="en" role="answer"
# **Answer 2.** In most runs the car never finds the flag within 450 episodes. With correct targets, all values slide
# towards $-1 / (1 - \gamma) = -100$ before the flag is seen: every state looks equally bad, so the greedy action
# means nothing. A time limit that terminates gives states that are seen late in an episode a higher value. The values
# differ, the car is drawn to places that it has reached lately, and it happens to swing higher. The values are wrong
# (the clock is not a part of the state), but the behavior explores. With a better explored problem, or a reward that
# says more, the correct target is better.

# %% [markdown] lang="fr" role="answer"
# **Réponse 2.** La plupart du temps, la voiture ne trouve jamais le drapeau en 450 épisodes. Avec des cibles
# correctes, toutes les valeurs glissent vers $-1 / (1 - \gamma) = -100$ avant que le drapeau ait été vu : tous les
# états paraissent aussi mauvais, et l'action gloutonne ne veut plus rien dire. Une limite de temps qui termine
# l'épisode donne une valeur plus élevée aux états vus tard dans un épisode. Les valeurs diffèrent, la voiture est
# attirée vers les endroits atteints récemment, et il se trouve qu'elle se balance plus haut. Les valeurs sont fausses
# (l'horloge ne fait pas partie de l'état), mais le comportement explore. Avec un problème mieux exploré, ou une
# récompense plus parlante, la cible correcte est meilleure.

# %% [markdown] lang="en" role="answer"
# **Answer 3.** With 1 the target network is always the network itself: the targets move with every step, and learning
# becomes less stable (the values may grow without bound). With 1000 the targets are calm but old: what was learned
# about the flag moves back by one step of the car with each copy, so learning is slow.

# %% [markdown] lang="fr" role="answer"
# **Réponse 3.** Avec 1, le réseau cible est toujours le réseau lui-même : les cibles bougent à chaque pas, et
# l'apprentissage devient moins stable (les valeurs peuvent croître sans limite). Avec 1000, les cibles sont calmes
# mais vieilles : ce qui a été appris sur le drapeau ne remonte que d'un pas de la voiture à chaque copie, donc
# l'apprentissage est lent.

# %% [markdown] lang="en"
# Now play against your agent: both start from the same state in each round. Who needs fewer steps?

# %% [markdown] lang="fr"
# Jouez maintenant contre votre agent : à chaque partie, vous partez tous deux du même état. Qui a besoin de moins de
# pas ?

# %%
my_scores["against the car"] = by_hand("Mountain", episodes=3, seed=0, against=car)

# %% [markdown] lang="en"
# ## 3. Proximal policy optimization
#
# DQN takes the best of a few actions. The engines of the lander take any number from -1 to 1, so there is no list to
# choose from. PPO learns the policy itself, with two networks:
#
# - The **actor** maps a state to a probability distribution of actions, $\pi(a \mid s)$. It acts by drawing from it, so
#   exploration is part of the policy.
# - The **critic** maps a state to the return that the actor can expect from there, $V(s)$. It judges whether an
#   action was better than usual.

# %% [markdown] lang="fr"
# ## 3. L'optimisation proximale de la politique
#
# DQN choisit la meilleure action parmi quelques-unes. Les moteurs du module lunaire acceptent tout nombre de -1 à 1 :
# il n'y a plus de liste où choisir. PPO apprend la politique elle-même, avec deux réseaux :
#
# - L'**acteur** associe à un état une loi de probabilité sur les actions, $\pi(a \mid s)$. Il agit en tirant selon
#   cette loi : l'exploration fait partie de la politique.
# - Le **critique** associe à un état le retour que l'acteur peut en espérer, $V(s)$. Il juge si une action a été
#   meilleure que d'habitude.

# %% [markdown] lang="en"
# ### 3.1 The actor
#
# Each component of the action has a normal distribution. The network gives the mean $\mu$; the logarithm of the
# standard deviation $\sigma$ is learned too. The components are independent, so the logarithms of their densities are
# added:
#
# $$\log \pi(a \mid s) = -\sum_j \left[ \frac{1}{2} \left( \frac{a_j - \mu_j}{\sigma_j} \right)^2 + \log \sigma_j
# {} + \frac{1}{2} \log 2 \pi \right] \tag{7}$$
#
# **Exercise 10.** `mean` and `action` have the shape `(n, n_components)`, `log_std` is $\log \sigma$ with the shape
# `(1, n_components)`. The result has the shape `(n,)`.

# %% [markdown] lang="fr"
# ### 3.1 L'acteur
#
# Chaque composante de l'action suit une loi normale. Le réseau donne la moyenne $\mu$ ; le logarithme de l'écart-type
# $\sigma$ est appris lui aussi. Les composantes sont indépendantes, donc les logarithmes de leurs densités s'ajoutent
# :
#
# $$\log \pi(a \mid s) = -\sum_j \left[ \frac{1}{2} \left( \frac{a_j - \mu_j}{\sigma_j} \right)^2 + \log \sigma_j
# {} + \frac{1}{2} \log 2 \pi \right] \tag{7}$$
#
# **Exercice 10.** `mean` et `action` sont de forme `(n, n_components)`, `log_std` est $\log \sigma$, de forme
# `(1, n_components)`. Le résultat est de forme `(n,)`.


# %%
def log_prob(mean, log_std, action):
    # SOLUTION
    # [en] TODO: equation (7).
    # [fr] À FAIRE : l'équation (7).
    z = (action - mean) / jnp.exp(log_std)
    return jnp.sum(-0.5 * z**2 - log_std - 0.5 * jnp.log(2 * jnp.pi), axis=1)
    # END


check.log_prob(log_prob)

# %%
require("log_prob")
actions = np.linspace(-3, 3, 201)[:, None]
plt.figure(figsize=(6, 2.5))
for std in (0.3, 0.6, 1.0):
    density = np.exp(log_prob(np.zeros((201, 1)), np.log([[std]]), actions))
    plt.plot(actions, density, label=f"σ = {std}")
plt.xlabel("action")
plt.ylabel("density")  # [en]
plt.ylabel("densité")  # [fr]
plt.legend()
plt.show()

# %% [markdown] lang="en"
# ### 3.2 The critic and the advantage
#
# What follows an action is its **return to go**: $G_t = r_t + \gamma r_{t+1} + \dots + \gamma^{T-t} r_T$. Computed
# from the end of the episode it takes one multiplication for each step.
#
# **Exercise 11.** `rewards` are the rewards of one episode, in order.

# %% [markdown] lang="fr"
# ### 3.2 Le critique et l'avantage
#
# Ce qui suit une action est son **retour à venir** : $G_t = r_t + \gamma r_{t+1} + \dots + \gamma^{T-t} r_T$. Calculé
# en partant de la fin de l'épisode, il ne demande qu'une multiplication par pas.
#
# **Exercice 11.** `rewards` contient les récompenses d'un épisode, dans l'ordre.


# %%
def returns_to_go(rewards, gamma):
    result = np.zeros(len(rewards))
    following = 0.0
    for t in reversed(range(len(rewards))):
        # SOLUTION following = ...
        # [en] TODO: the return at time t, from rewards[t] and the return that follows.
        # [fr] À FAIRE : le retour à l'instant t, à partir de rewards[t] et du retour qui suit.
        following = rewards[t] + gamma * following
        # END
        result[t] = following
    return result


check.returns_to_go(returns_to_go)

# %% [markdown] lang="en"
# A return of 150 is good where 100 was to be expected, and bad where it was 200. What matters is the **advantage**:
# how much better it went than the critic expected. $G_t - V(s_t)$ is such an estimate, but it contains all the luck
# of the rest of the episode. The TD error $\delta_t = r_t + d_t V(s_{t+1}) - V(s_t)$ contains the luck of one step
# only, but it trusts the critic. PPO mixes both (*generalized advantage estimation*), with $0 \le \lambda \le 1$:
#
# $$A_t = \delta_t + d_t \lambda A_{t+1} \tag{8}$$
#
# Where an episode ended, by termination **or** truncation, the next step belongs to another episode, and the last
# term of (8) is left out. The discount $d_t$ is that of equation (2).
#
# **Exercise 12.** All arguments except `gae_lambda` are arrays `(n_envs,)`, with one number for each environment;
# `following` is $A_{t+1}$.

# %% [markdown] lang="fr"
# Un retour de 150 est bon là où l'on attendait 100, et mauvais là où l'on attendait 200. Ce qui compte, c'est
# l'**avantage** : de combien les choses se sont mieux passées que le critique ne s'y attendait. $G_t - V(s_t)$ en est
# une estimation, mais elle contient tout le hasard de la suite de l'épisode. L'erreur TD
# $\delta_t = r_t + d_t V(s_{t+1}) - V(s_t)$ ne contient que le hasard d'un pas, mais elle se fie au critique. PPO
# mélange les deux (*estimation généralisée de l'avantage*), avec $0 \le \lambda \le 1$ :
#
# $$A_t = \delta_t + d_t \lambda A_{t+1} \tag{8}$$
#
# Là où un épisode a fini, par terminaison **ou** par troncature, le pas suivant appartient à un autre épisode, et
# l'on omet le dernier terme de (8). Le facteur $d_t$ est celui de l'équation (2).
#
# **Exercice 12.** Tous les arguments sauf `gae_lambda` sont des tableaux `(n_envs,)`, avec un nombre par
# environnement ; `following` est $A_{t+1}$.


# %%
def advantage(reward, value, next_value, discount, ended, following, gae_lambda):
    # SOLUTION
    # [en] TODO: equation (8). ended says where an episode ended.
    # [fr] À FAIRE : l'équation (8). ended indique où un épisode a fini.
    delta = reward + discount * next_value - value
    return delta + jnp.where(ended, 0.0, discount * gae_lambda * following)
    # END


check.advantage(advantage)

# %% [markdown] lang="en"
# ### 3.3 The probability ratio and its clip
#
# PPO plays a few thousand steps, then learns from them several times. With each gradient step the policy $\pi$
# departs from the one that played, $\pi_{\text{old}}$. The ratio says how much more probable an action has become:
#
# $$\rho = \frac{\pi(a \mid s)}{\pi_{\text{old}}(a \mid s)}
# = \exp\left( \log \pi(a \mid s) - \log \pi_{\text{old}}(a \mid s) \right) \tag{9}$$
#
# **Exercise 13.** `new` and `old` are log-probabilities.

# %% [markdown] lang="fr"
# ### 3.3 Le rapport de probabilités et son écrêtage
#
# PPO joue quelques milliers de pas, puis apprend plusieurs fois sur ceux-ci. À chaque pas de gradient, la politique
# $\pi$ s'éloigne de celle qui a joué, $\pi_{\text{old}}$. Le rapport dit combien une action est devenue plus probable
# :
#
# $$\rho = \frac{\pi(a \mid s)}{\pi_{\text{old}}(a \mid s)}
# = \exp\left( \log \pi(a \mid s) - \log \pi_{\text{old}}(a \mid s) \right) \tag{9}$$
#
# **Exercice 13.** `new` et `old` sont des log-probabilités.


# %%
def ratio(new, old):
    # SOLUTION
    # [en] TODO: equation (9).
    # [fr] À FAIRE : l'équation (9).
    return jnp.exp(new - old)
    # END


check.ratio(ratio)

# %% [markdown] lang="en"
# Making good actions more probable and bad ones less probable means to raise $\rho A$. But the advantages were
# measured with the old policy; far from it they mean nothing. So nothing is gained by moving $\rho$ further than $c$
# away from 1. To minimize:
#
# $$L_\pi = -\frac{1}{n} \sum_{i=1}^{n} \min\left( \rho_i A_i,\;
# \operatorname{clip}(\rho_i, 1 - c, 1 + c)\, A_i \right) \tag{10}$$
#
# **Exercise 14.** Use `jnp.clip` and `jnp.minimum`. The result is one number.

# %% [markdown] lang="fr"
# Rendre plus probables les bonnes actions et moins probables les mauvaises, c'est augmenter $\rho A$. Mais les
# avantages ont été mesurés avec l'ancienne politique ; loin d'elle, ils ne veulent plus rien dire. On ne gagne donc
# rien à éloigner $\rho$ de 1 de plus de $c$. À minimiser :
#
# $$L_\pi = -\frac{1}{n} \sum_{i=1}^{n} \min\left( \rho_i A_i,\;
# \operatorname{clip}(\rho_i, 1 - c, 1 + c)\, A_i \right) \tag{10}$$
#
# **Exercice 14.** Utilisez `jnp.clip` et `jnp.minimum`. Le résultat est un seul nombre.


# %%
def policy_loss(ratio, advantage, clip):
    # SOLUTION
    # [en] TODO: equation (10).
    # [fr] À FAIRE : l'équation (10).
    clipped = jnp.clip(ratio, 1 - clip, 1 + clip)
    return -jnp.mean(jnp.minimum(ratio * advantage, clipped * advantage))
    # END


check.policy_loss(policy_loss)

# %% [markdown] lang="en"
# What one action gains, as a function of its ratio. Where the curve is flat, the gradient is 0 and nothing pulls any
# further.

# %% [markdown] lang="fr"
# Ce que gagne une action, en fonction de son rapport. Là où la courbe est plate, le gradient est nul et plus rien ne
# tire.

# %%
require("policy_loss")
ratios = np.linspace(0, 2, 201)
figure, axes = plt.subplots(1, 2, figsize=(9, 3), sharex=True)
for axis, sign in zip(axes, (1.0, -1.0), strict=True):
    gains = [-policy_loss(np.array([r]), np.array([sign]), 0.2) for r in ratios]
    axis.plot(ratios, gains)
    axis.axvline(1, color="grey", linewidth=0.5)
    axis.set_title(f"A = {sign:+.0f}")
    axis.set_xlabel("ρ")
plt.show()

# %% [markdown] lang="en"
# **Question 4.** For $A = -1$ the curve is flat below 0.8 but falls without limit above 1.2. Why is it not clipped
# there as well?

# %% [markdown] lang="fr"
# **Question 4.** Pour $A = -1$, la courbe est plate sous 0,8 mais descend sans limite au-dessus de 1,2. Pourquoi
# n'est-elle pas écrêtée là aussi ?

# %% [markdown] lang="en" role="answer"
# **Answer.** There a bad action has become *more* probable, by accident. The gradient must be able to undo that, so
# it is kept. The minimum removes only what would reward going further; the bound is pessimistic.

# %% [markdown] lang="fr" role="answer"
# **Réponse.** À cet endroit, une mauvaise action est devenue *plus* probable, par accident. Le gradient doit pouvoir
# corriger cela, il est donc conservé. Le minimum ne retire que ce qui récompenserait d'aller plus loin ; la borne est
# pessimiste.

# %% [markdown] lang="en"
# ### 3.4 The loss of the critic
#
# The critic learns the targets $A_t + V(s_t)$ by the mean squared error.
#
# **Exercise 15.** The last layer of the critic has one output, so `value` has the shape `(n, 1)`; `target` has the
# shape `(n,)`.

# %% [markdown] lang="fr"
# ### 3.4 La perte du critique
#
# Le critique apprend les cibles $A_t + V(s_t)$ par l'erreur quadratique moyenne.
#
# **Exercice 15.** La dernière couche du critique a une seule sortie, donc `value` est de forme `(n, 1)` ; `target`
# est de forme `(n,)`.


# %%
def value_loss(value, target):
    # SOLUTION
    # [en] TODO: the mean squared error.
    # [fr] À FAIRE : l'erreur quadratique moyenne.
    return jnp.mean((value[:, 0] - target) ** 2)
    # END


check.value_loss(value_loss)

# %% [markdown] lang="en"
# ### 3.5 Training
#
# Again your functions replace those of rejeu. `update` gets a rollout: what 16 environments did in `n_steps` steps
# each, arrays `(n_steps, n_envs, ...)`. It computes the advantages backwards, then takes a gradient step on each
# minibatch, `n_epochs` times.

# %% [markdown] lang="fr"
# ### 3.5 L'entraînement
#
# De nouveau, vos fonctions remplacent celles de rejeu. `update` reçoit ce que 16 environnements ont fait en `n_steps`
# pas chacun, des tableaux `(n_steps, n_envs, ...)`. Elle calcule les avantages à rebours, puis fait un pas de
# gradient sur chaque mini-lot, `n_epochs` fois.

# %%
require("log_prob", "advantage", "ratio", "policy_loss", "value_loss")


def make_ppo(config, observation_space, action_space):
    parts = ppo.make(config, observation_space, action_space)
    optimizer = optimizers.make(config.optimizer)

    def loss(network, batch):
        obs, action, old, gain, target = batch
        policy, value = network.both(obs)
        rho = ratio(log_prob(policy.mean, policy.log_std, action), old)
        gain = (gain - jnp.mean(gain)) / (jnp.std(gain) + 1e-8)
        entropy = jnp.mean(policy.entropy())
        critic = value_loss(value[:, None], target)
        return policy_loss(rho, gain, config.clip_range) + config.vf_coef * critic - config.ent_coef * entropy

    def update(state, rollout, clock):
        n_steps, n_envs = rollout.reward.shape

        def flat(x):
            return x.reshape(n_steps * n_envs, *x.shape[2:])

        def by_time(x):
            return x.reshape(n_steps, n_envs)

        policy, value = state.network.both(flat(rollout.obs))
        old = log_prob(policy.mean, policy.log_std, flat(rollout.action))
        next_value = state.network.value(flat(rollout.next_obs))

        # [en] Advantages, from the last step to the first.
        # [fr] Les avantages, du dernier pas au premier.
        def back(following, step):
            result = advantage(*step, following, config.gae_lambda)
            return result, result

        step = (rollout.reward, by_time(value), by_time(next_value), rollout.discount, rollout.ended)
        _, gain = jax.lax.scan(back, jnp.zeros(n_envs), step, reverse=True)
        data = (flat(rollout.obs), flat(rollout.action), old, flat(gain), flat(gain) + value)

        # [en] Each epoch in a new order, cut into minibatches.
        # [fr] Chaque époque dans un nouvel ordre, découpée en mini-lots.
        keys = jax.random.split(jax.random.fold_in(state.key, state.n_rollouts), config.n_epochs)
        orders = jax.vmap(lambda key: jax.random.permutation(key, n_steps * n_envs))(keys)
        rate = at(config.learning_rate, clock.progress)

        def minibatch(learned, rows):
            network, moments = learned
            value, gradient = jax.value_and_grad(loss)(network, jax.tree.map(lambda x: x[rows], data))
            return descend(network, clip(gradient, None, config.max_grad_norm), moments, optimizer, rate), value

        learned, losses = jax.lax.scan(
            minibatch, (state.network, state.optimizer), orders.reshape(-1, config.batch_size)
        )
        n_updates = state.n_updates + len(losses)
        return ppo.State(*learned, state.key, n_updates, state.n_rollouts + 1), {"loss": jnp.mean(losses)}

    return parts._replace(update=update)


class MyPPO(rejeu.OnPolicyAgent):
    algorithm = SimpleNamespace(Config=ppo.Config, make=make_ppo)


# %%
n_envs, n_steps = 16, 256
lander = MyPPO(
    "MlpPolicy",
    rejeu.make_vector("LunarLanderContinuous-v3", n_envs=n_envs, seed=0),
    n_steps=n_steps,
    batch_size=256,
    n_epochs=8,
    gamma=0.999,
    gae_lambda=0.98,
    ent_coef=0.01,
    clip_range=0.2,
    learning_rate=rejeu.Linear(1e-3, 0.0),
    success_threshold=200.0,
    seed=0,
)
every = RecordVideo("videos/lander", every=n_envs * n_steps * steps(25), max_steps=500, seed=0)
lander.learn(n_envs * n_steps * steps(100), callback=every)
print(lander.history)

# %%
lander.history.plot()

# %%
rejeu.show_videos("videos/lander")

# %% [markdown] lang="en"
# ### 3.6 Statistics
#
# A landing counts as a success from a return of 200 on.

# %% [markdown] lang="fr"
# ### 3.6 Statistiques
#
# Un atterrissage compte comme un succès à partir d'un retour de 200.

# %%
require("success_rate")
print(HEADER.replace("MountainCar", "LunarLander"))
statistics("random", *random_episodes("LunarLanderContinuous-v3", 50), 200)  # [en]
statistics("au hasard", *random_episodes("LunarLanderContinuous-v3", 50), 200)  # [fr]
returns, lengths = lander.history["return"], lander.history["length"]
statistics("training, first 100", returns[:100], lengths[:100], 200)  # [en]
statistics("entraînement, 100 prem.", returns[:100], lengths[:100], 200)  # [fr]
statistics("training, last 100", returns[-100:], lengths[-100:], 200)  # [en]
statistics("entraînement, 100 dern.", returns[-100:], lengths[-100:], 200)  # [fr]
result = lander.evaluate(episodes=50, env="LunarLanderContinuous-v3", seed=1)
statistics("no noise, new episodes", result.returns, result.lengths, 200)  # [en]
statistics("sans bruit, autres épis.", result.returns, result.lengths, 200)  # [fr]
statistics("you", np.array(my_scores["Lunar"]), np.array([np.nan]), 200)  # [en]
statistics("vous", np.array(my_scores["Lunar"]), np.array([np.nan]), 200)  # [fr]
result.plot()

# %% [markdown] lang="en"
# **Question 5.** DQN learns each transition many times, PPO learns a rollout a few times and throws it away. Why can
# PPO not use a replay memory as DQN does?
#
# **Question 6.** Set `clip_range` to 10. What do you expect?
#
# **Question 7.** The landings without noise are better than those of the last training episodes. Why?

# %% [markdown] lang="fr"
# **Question 5.** DQN apprend chaque transition de nombreuses fois, PPO apprend quelques fois sur ses données puis les
# jette. Pourquoi PPO ne peut-il pas utiliser une mémoire de rejeu comme DQN ?
#
# **Question 6.** Réglez `clip_range` à 10. À quoi vous attendez-vous ?
#
# **Question 7.** Les atterrissages sans bruit sont meilleurs que ceux des derniers épisodes d'entraînement. Pourquoi ?

# %% [markdown] lang="en" role="answer"
# **Answer 5.** The advantages and the ratio refer to the policy that played. For transitions of a much older policy,
# the ratio is far from 1 almost everywhere, the clip removes the gradient, and the advantages are those of another
# policy. Equation (3) of DQN holds for any transition, whoever played it: DQN is *off-policy*, PPO is *on-policy*.
#
# **Answer 6.** Without a bound, eight epochs on the same data may carry the policy to where the advantages say nothing.
# Training becomes less reliable: the return can rise and then collapse, and the policy can lose its exploration.
#
# **Answer 7.** In training the actions are drawn from the distribution, with the standard deviation that the entropy bonus
# keeps from vanishing. The engines still fire on the ground now and then, the lander does not come to rest, and the episode
# goes on until the time limit. `evaluate` takes the mean of the distribution.

# %% [markdown] lang="fr" role="answer"
# **Réponse 5.** Les avantages et le rapport se réfèrent à la politique qui a joué. Pour des transitions d'une
# politique bien plus ancienne, le rapport est presque partout loin de 1, l'écrêtage annule le gradient, et les
# avantages sont ceux d'une autre politique. L'équation (3) de DQN vaut pour toute transition, quel que soit celui qui
# a joué : DQN est *hors politique* (off-policy), PPO est *sur la politique* (on-policy).
#
# **Réponse 6.** Sans borne, huit époques sur les mêmes données peuvent emmener la politique là où les avantages ne disent
# plus rien. L'entraînement devient moins fiable : le retour peut monter puis s'effondrer, et la politique peut perdre son
# exploration.
#
# **Réponse 7.** Pendant l'entraînement, les actions sont tirées selon la loi, avec un écart-type que le bonus d'entropie
# empêche de s'annuler. Au sol, les moteurs s'allument encore de temps en temps, le module ne s'immobilise pas, et l'épisode
# dure jusqu'à la limite de temps. `evaluate` prend la moyenne de la loi.

# %%
my_scores["against the lander"] = by_hand("LunarLanderContinuous-v3", episodes=3, seed=0, against=lander)

# %% [markdown] lang="en"
# ## 4. Hand in your agents
#
# The files contain the weights and the settings, no code. Your teacher makes a table of a folder of such files with
# `rejeu class FOLDER`; put your name in the file name.

# %% [markdown] lang="fr"
# ## 4. Rendre vos agents
#
# Les fichiers contiennent les poids et les réglages, aucun code. Votre enseignant fait un tableau d'un dossier de
# tels fichiers avec `rejeu class DOSSIER` ; mettez votre nom dans le nom du fichier.

# %%
print(car.save("my_name_car"), lander.save("my_name_lander"))  # [en]
print(car.save("mon_nom_voiture"), lander.save("mon_nom_module"))  # [fr]

# %% [markdown] lang="en"
# **To go further**
#
# - Train with another seed. How much do the results differ? Why is one run not enough to compare two settings?
# - Double Q-learning: choose the next action with the network, evaluate it with the target network. Which function
#   changes?
# - The same agents in one line each: `rejeu.DQN("MlpPolicy", "MountainCar-v0")` and
#   `rejeu.PPO("MlpPolicy", "LunarLanderContinuous-v3")`, or `rejeu train LunarLanderContinuous-v3` in a terminal.

# %% [markdown] lang="fr"
# **Pour aller plus loin**
#
# - Entraînez avec une autre graine. De combien les résultats diffèrent-ils ? Pourquoi un seul entraînement ne
#   suffit-il pas pour comparer deux réglages ?
# - Le double Q-learning : choisir l'action suivante avec le réseau, l'évaluer avec le réseau cible. Quelle fonction
#   change ?
# - Les mêmes agents en une ligne chacun : `rejeu.DQN("MlpPolicy", "MountainCar-v0")` et
#   `rejeu.PPO("MlpPolicy", "LunarLanderContinuous-v3")`, ou `rejeu train LunarLanderContinuous-v3` dans un terminal.
