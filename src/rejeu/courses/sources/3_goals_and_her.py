# %% [markdown] lang="en"
# # Course 3: Goals and HER
#
# In many tasks the goal changes from episode to episode: reach *this* point, park in *this* space. The reward is
# often rare: nothing happens until the goal is reached. **Hindsight experience replay** (HER,
# [Andrychowicz et al. 2017](https://arxiv.org/abs/1707.01495)) learns from failures: an episode that missed its goal
# has reached other states, and for these goals it was a success.
#
# You write the relabeling and the strategies of HER, see their effect on a puzzle within a minute, and then teach a
# car to park. At the end you save models and replay buffers, continue a training, resume it exactly, and record a
# video.

# %% [markdown] lang="fr"
# # Cours 3 : Buts et HER
#
# Dans bien des tâches, le but change d'un épisode à l'autre : atteindre *ce* point, se garer sur *cette* place.
# Souvent, la récompense est rare : rien ne se passe tant que le but n'est pas atteint. Le **rejeu a posteriori**
# (*hindsight experience replay*, HER, [Andrychowicz et al. 2017](https://arxiv.org/abs/1707.01495)) apprend des
# échecs : un épisode qui a manqué son but a atteint d'autres états, et pour ces buts-là, c'était une réussite.
#
# Vous allez écrire le ré-étiquetage et les stratégies de HER, voir leur effet sur un casse-tête en moins d'une
# minute, puis apprendre à une voiture à se garer. À la fin, vous enregistrerez des modèles et des mémoires de rejeu,
# continuerez un entraînement, le reprendrez exactement, et filmerez le résultat.

# %%
import tempfile
from pathlib import Path
from typing import Any, NamedTuple

import gymnasium as gym
import jax
import matplotlib.pyplot as plt
import numpy as np

import rejeu
from rejeu.algorithms import dqn
from rejeu.callbacks import Checkpoint
from rejeu.courses import steps
from rejeu.courses.checks import goals as check, require, speak

speak("{language}")
folder = Path(tempfile.mkdtemp())

# %% [markdown] lang="en"
# ## 1. A puzzle with a goal
#
# There are $n$ bits. A random state and a random goal are drawn; an action flips one bit. Each step costs 1 until the
# state is equal to the goal, and after $n$ steps the clock stops the episode. The observation of a goal environment
# is a dictionary:
#
# | key | content |
# |---|---|
# | `observation` | what the agent sees |
# | `achieved_goal` | which goal it has reached at this moment; here the state itself |
# | `desired_goal` | which goal it should reach |
#
# What makes hindsight possible is the function `compute_reward(achieved_goal, desired_goal, info)`: it answers for
# *any* goal. HER calls it for whole batches, with goals of shape `(batch, n_bits)`.

# %% [markdown] lang="fr"
# ## 1. Un casse-tête avec un but
#
# On a $n$ bits. On tire au hasard un état et un but ; une action inverse un bit. Chaque pas coûte 1 tant que l'état
# n'est pas égal au but, et après $n$ pas, l'horloge arrête l'épisode. L'observation d'un environnement à buts est un
# dictionnaire :
#
# | clé | contenu |
# |---|---|
# | `observation` | ce que voit l'agent |
# | `achieved_goal` | le but atteint à cet instant ; ici, l'état lui-même |
# | `desired_goal` | le but à atteindre |
#
# Ce qui rend HER possible, c'est la fonction `compute_reward(achieved_goal, desired_goal, info)` : elle répond pour
# *n'importe quel* but. HER l'appelle sur des lots entiers, avec des buts de forme `(lot, n_bits)`.


# %%
def compute_reward(achieved_goal, desired_goal, info):
    """Returns 0 where the goal is reached and -1 elsewhere, for one goal (n_bits,) or a batch (n, n_bits)."""  # [en]
    """Renvoie 0 où le but est atteint et -1 ailleurs, pour un but (n_bits,) ou un lot (n, n_bits)."""  # [fr]
    # SOLUTION return ...
    return np.where(np.all(achieved_goal == desired_goal, axis=-1), 0.0, -1.0)
    # END


check.compute_reward(compute_reward)


# %%
# [en] Flip bits until the state is equal to the goal.
# [fr] Inverser des bits jusqu'à ce que l'état soit égal au but.
class Bits(gym.Env):
    def __init__(self, n_bits=12):
        self.n_bits, keys = n_bits, ("observation", "achieved_goal", "desired_goal")
        self.observation_space = gym.spaces.Dict({key: gym.spaces.MultiBinary(n_bits) for key in keys})
        self.action_space = gym.spaces.Discrete(n_bits)

    def observe(self):
        return {"observation": self.state, "achieved_goal": self.state, "desired_goal": self.goal}

    def reset(self, seed=None, options=None):
        super().reset(seed=seed)
        self.state, self.goal = self.np_random.integers(0, 2, (2, self.n_bits), dtype=np.int8)
        self.time = 0
        return self.observe(), {}

    def step(self, action):
        self.state = self.state.copy()
        self.state[action] ^= 1
        self.time += 1
        reward = float(self.compute_reward(self.state, self.goal, {}))
        terminated, truncated = reward == 0, self.time >= self.n_bits
        return self.observe(), reward, terminated, truncated and not terminated, {"is_success": terminated}

    def compute_reward(self, achieved_goal, desired_goal, info):
        return compute_reward(achieved_goal, desired_goal, info)

    def compute_terminated(self, achieved_goal, desired_goal, info):
        return compute_reward(achieved_goal, desired_goal, info) == 0


# %% [markdown] lang="en"
# An agent that knows nothing ends an episode in a random state. With 12 bits, how many episodes does it take on
# average until one of them ends on its goal? (Only the order of magnitude matters.)

# %% [markdown] lang="fr"
# Un agent qui ne sait rien finit un épisode dans un état au hasard. Avec 12 bits, combien d'épisodes faut-il en
# moyenne pour que l'un d'eux finisse sur son but ? (Seul l'ordre de grandeur compte.)

# %%
# SOLUTION episodes_needed = ...
episodes_needed = 2**12
# END
check.steps_needed(episodes_needed)

# %% [markdown] lang="en"
# ## 2. Relabeling
#
# A step of an episode is stored as below. For another goal the same thing would have happened, but the agent would
# have *seen* another goal, the reward would have been another one, and so would the answer to whether the episode
# terminated. Write `relabel`. Do not change the step that you get: make new dictionaries, such as
# `{**step.obs, "desired_goal": goal}`.

# %% [markdown] lang="fr"
# ## 2. Le ré-étiquetage
#
# Un pas d'un épisode est enregistré comme ci-dessous. Avec un autre but, il se serait passé la même chose, mais
# l'agent aurait *vu* un autre but, la récompense aurait été une autre, et la réponse à la question « l'épisode est-il
# terminé ? » aussi. Écrivez `relabel`. Ne modifiez pas le pas reçu : créez de nouveaux dictionnaires, comme
# `{**step.obs, "desired_goal": goal}`.


# %%
# [en] A step of an episode.
# [fr] Un pas d'un épisode.
class Step(NamedTuple):
    obs: dict
    action: Any
    reward: float
    next_obs: dict
    terminated: bool


def relabel(step, goal):
    """Returns the step as it would have been with another goal."""  # [en]
    """Renvoie le pas tel qu'il aurait été avec un autre but."""  # [fr]
    # SOLUTION
    # [en] TODO: both observations, the reward (which achieved goal decides?), terminated. The end: return Step(...)
    # [fr] À FAIRE : les deux observations, la récompense (quel but atteint compte ?), terminated. À la fin : return Step(...)
    reward = float(compute_reward(step.next_obs["achieved_goal"], goal, {}))
    obs, next_obs = ({**seen, "desired_goal": goal} for seen in (step.obs, step.next_obs))
    return Step(obs, step.action, reward, next_obs, terminated=reward == 0)
    # END


check.relabel(relabel)

# %% [markdown] lang="en"
# Which goals? The strategy **future** takes goals that were achieved later in the same episode, after the step at the
# earliest. Of each step, `hindsight` keeps the original and adds $k$ relabeled copies.

# %% [markdown] lang="fr"
# Quels buts ? La stratégie **future** prend des buts atteints plus tard dans le même épisode, au plus tôt juste après
# le pas. De chaque pas, `hindsight` garde l'original et ajoute $k$ copies ré-étiquetées.


# %%
def hindsight(episode, k, rng):
    """Returns a list of the steps of an episode and of k relabeled copies of each."""  # [en]
    """Renvoie une liste des pas d'un épisode et de k copies ré-étiquetées de chacun."""  # [fr]
    result = []
    for t, step in enumerate(episode):
        # SOLUTION
        # [en] TODO: append the step, then k times relabel(step, goal). The goal is in next_obs of a random later step.
        # [fr] À FAIRE : ajouter le pas, puis k fois relabel(step, goal). Le but vient du next_obs d'un pas ultérieur.
        result.append(step)
        times = rng.integers(t, len(episode), size=k)
        result.extend(relabel(step, episode[later].next_obs["achieved_goal"]) for later in times)
        # END
    return result


check.hindsight(hindsight)

# %% [markdown] lang="en"
# ## 3. HER in forty lines
#
# The loop below plays episodes with DQN, puts the steps into a replay memory with or without your hindsight, and
# learns from random batches. Both runs have the same number of steps and of updates; only the contents of the memory
# differ.

# %% [markdown] lang="fr"
# ## 3. HER en quarante lignes
#
# La boucle ci-dessous joue des épisodes avec DQN, met les pas dans une mémoire de rejeu, avec ou sans votre
# `hindsight`, et apprend sur des lots tirés au hasard. Les deux essais ont le même nombre de pas et de mises à jour ;
# seul le contenu de la mémoire diffère.


# %%
def train(n_episodes, k, seed=0):
    """Returns whether each episode succeeded, and the share of stored steps that reach their goal."""  # [en]
    """Renvoie la réussite de chaque épisode, et la part des pas enregistrés qui atteignent leur but."""  # [fr]
    env, rng = Bits(10), np.random.default_rng(seed)
    config = dqn.Config(
        learning_rate=1e-3,
        batch_size=128,
        target_update_interval=100,
        exploration_initial_eps=0.3,
        exploration_final_eps=0.02,
        policy_kwargs={"net_arch": [256]},
    )
    algorithm = dqn.make(config, env.observation_space, env.action_space)
    update, key = jax.jit(algorithm.update), jax.random.key(seed)

    @jax.jit
    def explore(state, obs, clock):
        obs = jax.tree.map(lambda x: x[None], obs)
        return algorithm.explore(algorithm.actor(state), obs, jax.random.fold_in(key, clock.step), clock)[0]

    memory = rejeu.ReplayMemory(100_000, env.observation_space, env.action_space, gamma=0.95, seed=seed)
    state, step, successes, stored = algorithm.init(key), 0, [], []
    for i in range(n_episodes):
        obs, _ = env.reset(seed=seed if i == 0 else None)
        episode, done = [], False
        while not done:
            clock = rejeu.Clock(np.uint32(step), np.uint32(i), np.float32(i / n_episodes))
            action = int(explore(state, obs, clock))
            next_obs, reward, terminated, truncated, _ = env.step(action)
            episode.append(Step(obs, action, reward, next_obs, terminated))
            obs, done, step = next_obs, terminated or truncated, step + 1
            if len(memory) > 500:
                state, _ = update(state, memory.sample(128), clock)
        for one in hindsight(episode, k, rng):
            memory.push(*one)
            stored.append(one.terminated)
        successes.append(terminated)
    return np.array(successes), np.mean(stored)


require("compute_reward", "relabel", "hindsight")
figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
for k in (0, 4):
    successes, share = train(steps(500), k)
    label = f"with {k} relabeled copies" if k else "without hindsight"  # [en]
    label = f"avec {k} copies ré-étiquetées" if k else "sans HER"  # [fr]
    print(f"{label}: {share:.1%} of the stored steps reach their goal")  # [en]
    print(f"{label} : {100 * share:.1f} % des pas enregistrés atteignent leur but".replace(".", ","))  # [fr]
    average = np.convolve(successes, np.ones(50) / 50, mode="valid")
    axis.plot(np.arange(len(average)) + 50, average, label=label)
axis.set(xlabel="episode", ylabel="success rate of 50 episodes", ylim=(-0.02, 1.02))  # [en]
axis.set(xlabel="épisode", ylabel="taux de réussite sur 50 épisodes", ylim=(-0.02, 1.02))  # [fr]
axis.set_title("Bits, 10 bits")  # [en]
axis.set_title("Casse-tête à 10 bits")  # [fr]
axis.legend()
plt.show()

# %% [markdown] lang="en"
# **Question.** HER does not teach the agent anything about the goals of the environment. Why does it solve them
# nevertheless?

# %% [markdown] lang="fr"
# **Question.** HER n'apprend rien à l'agent sur les buts de l'environnement. Pourquoi les résout-il tout de même ?

# %% [markdown] lang="en" role="answer"
# *Answer.* The goal is an input of the network. What it learns for achieved goals, one flip away, then two, then
# more, holds for every pair of state and goal that looks alike, and the network generalizes: a bit that differs
# should be flipped. In this puzzle the achieved goals cover the space as well as the desired ones do. Where they do
# not, for example if the agent never reaches the region of the desired goals, HER does not help.

# %% [markdown] lang="fr" role="answer"
# *Réponse.* Le but est une entrée du réseau. Ce qu'il apprend pour les buts atteints, à une inversion de distance,
# puis deux, puis davantage, vaut pour toute paire semblable d'un état et d'un but, et le réseau généralise : un bit
# qui diffère doit être inversé. Dans ce casse-tête, les buts atteints couvrent l'espace aussi bien que les buts
# désirés. Là où ce n'est pas le cas, par exemple si l'agent n'atteint jamais la région des buts désirés, HER n'aide
# pas.

# %% [markdown] lang="en"
# ## 4. Strategies
#
# rejeu relabels when a batch is drawn, so nothing is stored twice, and it accepts a strategy as a function. It gets
# arrays with one entry for each step to relabel: `time` of its observation, and `first` and `last`, the times of its
# episode whose achieved goals may be chosen. Its next observation has the time `time + 1`. It returns the chosen
# times.
#
# | strategy | goals |
# |---|---|
# | `future` | of a later time of the episode |
# | `final` | of its last time |
# | `episode` | of any time from `first` to `last` |

# %% [markdown] lang="fr"
# ## 4. Les stratégies
#
# rejeu ré-étiquette au moment où un lot est tiré, si bien que rien n'est enregistré deux fois, et il accepte comme
# stratégie une fonction. Elle reçoit des tableaux, avec un élément par pas à ré-étiqueter : `time`, l'instant de son
# observation, puis `first` et `last`, les instants de son épisode dont les buts atteints peuvent être choisis.
# L'observation suivante a l'instant `time + 1`. La fonction renvoie les instants choisis.
#
# | stratégie | buts |
# |---|---|
# | `future` | d'un instant ultérieur de l'épisode |
# | `final` | de son dernier instant |
# | `episode` | d'un instant quelconque de `first` à `last` |


# %%
def future(rng, time, first, last):
    # SOLUTION return ...
    return rng.integers(time + 1, last + 1)
    # END


def final(rng, time, first, last):
    # SOLUTION return ...
    return last
    # END


def episode(rng, time, first, last):
    # SOLUTION return ...
    return rng.integers(first, last + 1)
    # END


check.future(future)
check.final(final)
check.episode(episode)

# %%
require("future", "final", "episode")
figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
for strategy in (None, future, final, episode):
    her = {"replay_buffer_class": "HerReplayBuffer", "replay_buffer_kwargs": {"goal_selection_strategy": strategy}}
    agent = rejeu.DQN(
        "MultiInputPolicy",
        rejeu.make_vector(lambda: Bits(12), n_envs=2, seed=0),
        learning_rate=1e-3,
        batch_size=256,
        gamma=0.95,
        train_freq=1,
        target_update_interval=50,
        buffer_size=20_000,
        exploration_fraction=0.3,
        exploration_final_eps=0.01,
        policy_kwargs={"net_arch": [256]},
        seed=0,
        **(her if strategy else {}),
    )
    agent.learn(steps(3_000))
    name = strategy.__name__ if strategy else "without HER"  # [en]
    name = strategy.__name__ if strategy else "sans HER"  # [fr]
    axis.plot(agent.history["step"], agent.history.moving_average("success", 50), label=name)
axis.set(xlabel="step", ylabel="success rate of 50 episodes", title="Bits, 12 bits")  # [en]
axis.set(xlabel="pas", ylabel="taux de réussite sur 50 épisodes", title="Casse-tête à 12 bits")  # [fr]
axis.legend()
plt.show()

# %% [markdown] lang="en"
# **Question.** With `episode`, about half of the goals lie in the past of the step. Are such steps wrong, or of no
# use?

# %% [markdown] lang="fr"
# **Question.** Avec `episode`, environ la moitié des buts sont dans le passé du pas. De tels pas sont-ils faux, ou
# inutiles ?

# %% [markdown] lang="en" role="answer"
# *Answer.* They are not wrong: reward and next state are right for any goal, and DQN learns from steps of any policy.
# They are less useful, as they mostly say that a step away from an old state does not reach it. A goal from the
# future is one that the action may have led to, so it shows more often what success looks like. One figure from one
# seed does not rank the strategies, however; for that, repeat it with several seeds.

# %% [markdown] lang="fr" role="answer"
# *Réponse.* Ils ne sont pas faux : récompense et état suivant sont justes pour n'importe quel but, et DQN apprend de
# pas issus de n'importe quelle politique. Ils sont moins utiles, car ils disent surtout qu'un pas qui s'éloigne d'un
# ancien état ne l'atteint pas. Un but pris dans le futur est un but auquel l'action a pu mener ; il montre donc plus
# souvent à quoi ressemble une réussite. Une seule figure, d'une seule graine, ne suffit pourtant pas à classer les
# stratégies ; pour cela, répétez-la avec plusieurs graines.

# %% [markdown] lang="en"
# ## 5. Parking
#
# [highway-env](https://github.com/Farama-Foundation/HighwayEnv)'s `parking-v0`: a car with two continuous actions,
# acceleration and steering, must stop in a given space, with the right heading. Goals are
# $(x, y, v_x, v_y, \cos h, \sin h)$. The reward measures the distance to the goal with weights
# $w=(1,0.3,0,0,0.02,0.02)$:
#
# $$r = -\sqrt{\sum_i w_i\,|g_i - g_i^{\text{desired}}|}.$$
#
# An episode ends as a success when $r > -0.12$.

# %% [markdown] lang="fr"
# ## 5. Se garer
#
# `parking-v0`, de [highway-env](https://github.com/Farama-Foundation/HighwayEnv) : une voiture à deux actions
# continues, accélération et direction, doit s'arrêter sur une place donnée, dans la bonne orientation. Les buts sont
# $(x, y, v_x, v_y, \cos h, \sin h)$. La récompense mesure la distance au but avec les poids
# $w=(1;0{,}3;0;0;0{,}02;0{,}02)$ :
#
# $$r = -\sqrt{\sum_i w_i\,|g_i - g_i^{\text{désiré}}|}.$$
#
# Un épisode est réussi, et se termine, dès que $r > -0{,}12$.


# %%
def parking_reward(achieved, desired, weights):
    """Returns the rewards (n,) for goals (n, 6)."""  # [en]
    """Renvoie les récompenses (n,) pour des buts (n, 6)."""  # [fr]
    # SOLUTION return ...
    return -np.sqrt(np.abs(achieved - desired) @ weights)
    # END


check.parking_reward(parking_reward)

# %%
import highway_env  # registers parking-v0

env = gym.make("parking-v0", render_mode="rgb_array")
obs, _ = env.reset(seed=1)
for name, values in obs.items():
    print(f"{name:14} {np.round(values, 2)}")
plt.figure(figsize=(7, 3.6), layout="constrained")
plt.imshow(env.render())
plt.axis("off")
plt.title("A car, and the space in which it should stop")  # [en]
plt.title("Une voiture, et la place où elle doit s'arrêter")  # [fr]
plt.show()
env.close()

# %% [markdown] lang="en"
# SAC and DDPG with HER, in 16 environments at once. With `pip install "rejeu[envpool]"` they are stepped in C++;
# without it the simulation in Python takes several minutes more. SAC explores by its random policy. DDPG needs noise.

# %% [markdown] lang="fr"
# SAC et DDPG avec HER, dans 16 environnements à la fois. Avec `pip install "rejeu[envpool]"`, ils sont calculés en
# C++ ; sans cela, la simulation en Python demande plusieurs minutes de plus. SAC explore par sa politique aléatoire.
# DDPG a besoin de bruit.


# %%
def make_parking(seed=0):
    """Returns 16 parking lots."""  # [en]
    """Renvoie 16 parkings."""  # [fr]
    return rejeu.make_vector("parking-v0", n_envs=16, seed=seed)


settings = {
    "replay_buffer_class": "HerReplayBuffer",
    "replay_buffer_kwargs": {"n_sampled_goal": 4, "goal_selection_strategy": "future"},
    "policy_kwargs": {"net_arch": [64, 64, 64], "layer_norm": True},
    "batch_size": 128,
    "learning_rate": 1e-3,
    "gamma": 0.95,
    "learning_starts": 1_024,
    "buffer_size": 100_000,
    "seed": 0,
}
sac = rejeu.SAC("MultiInputPolicy", make_parking(), **settings)
sac.learn(steps(24_000))
sac.evaluate(episodes=50)

# %%
ddpg = rejeu.DDPG("MultiInputPolicy", make_parking(), action_noise=rejeu.NormalActionNoise([0, 0], 0.2), **settings)
ddpg.learn(steps(24_000))
ddpg.evaluate(episodes=50)

# %%
figure, axis = plt.subplots(figsize=(7, 3.6), layout="constrained")
for name, agent in (("SAC", sac), ("DDPG", ddpg)):
    axis.plot(agent.history["step"], agent.history.moving_average("success", 50), label=name)
axis.set(xlabel="step", ylabel="success rate of 50 episodes", title="Parking")  # [en]
axis.set(xlabel="pas", ylabel="taux de réussite sur 50 épisodes", title="Se garer")  # [fr]
axis.legend()
plt.show()

# %% [markdown] lang="en"
# **Question.** The reward of parking is not rare at all: it tells the distance at every step. What can hindsight add?

# %% [markdown] lang="fr"
# **Question.** La récompense de ce parking n'est pas rare du tout : elle donne la distance à chaque pas. Que peut
# apporter HER ?

# %% [markdown] lang="en" role="answer"
# *Answer.* A step teaches the agent about one goal; relabeled, it teaches about many, and nothing has to be driven
# again for that. Above all, the distance is a poor guide to a car: to get into a space with the right heading, it
# must often drive away first. Hindsight shows how maneuvers end in some place with some heading. How much this gains
# is an experiment: train with and without `replay_buffer_class`, with several seeds.

# %% [markdown] lang="fr" role="answer"
# *Réponse.* Un pas renseigne l'agent sur un seul but ; ré-étiqueté, il le renseigne sur beaucoup d'autres, sans qu'il
# faille conduire de nouveau. Surtout, la distance est un mauvais guide pour une voiture : pour entrer dans une place
# avec la bonne orientation, elle doit souvent commencer par s'en éloigner. HER montre comment des manœuvres finissent
# quelque part, dans une certaine orientation. Ce que cela rapporte est affaire d'expérience : entraînez avec et sans
# `replay_buffer_class`, avec plusieurs graines.

# %% [markdown] lang="en"
# ## 6. Saving, loading, continuing
#
# `agent.save(path)` writes the model: networks, optimizers and hyperparameters. The replay buffer is not part of it,
# because it is large; it has `save_replay_buffer` and `load_replay_buffer`. `rejeu.SAC.load(path, env=env)` returns
# an agent that can be trained further. Write two functions that keep both.

# %% [markdown] lang="fr"
# ## 6. Enregistrer, charger, continuer
#
# `agent.save(path)` écrit le modèle : réseaux, optimiseurs et hyperparamètres. La mémoire de rejeu n'en fait pas
# partie, car elle est grande ; elle a `save_replay_buffer` et `load_replay_buffer`. `rejeu.SAC.load(path, env=env)`
# renvoie un agent que l'on peut continuer à entraîner. Écrivez deux fonctions qui gardent les deux.


# %%
def save_all(agent, folder):
    """Saves the model and the replay buffer into a folder."""  # [en]
    """Enregistre le modèle et la mémoire de rejeu dans un dossier."""  # [fr]
    # SOLUTION ...
    agent.save(folder / "model")
    agent.save_replay_buffer(folder / "replay_buffer")
    # END


def load_all(folder, env):
    """Returns the agent of a folder, with its replay buffer."""  # [en]
    """Renvoie l'agent d'un dossier, avec sa mémoire de rejeu."""  # [fr]
    # SOLUTION
    # [en] TODO: load the model with env, then the replay buffer, and return the agent.
    # [fr] À FAIRE : charger le modèle avec env, puis la mémoire de rejeu, et renvoyer l'agent.
    agent = rejeu.SAC.load(folder / "model", env=env)
    agent.load_replay_buffer(folder / "replay_buffer")
    return agent
    # END


check.saving(save_all, load_all, sac, make_parking(seed=1))

# %% [markdown] lang="en"
# With these two functions the training can go on tomorrow. `reset_num_timesteps=False` continues to count the steps.

# %% [markdown] lang="fr"
# Avec ces deux fonctions, l'entraînement peut continuer demain. `reset_num_timesteps=False` poursuit le décompte des
# pas.

# %%
require("saving")
save_all(sac, folder)
for path in sorted(folder.glob("*.safetensors")):
    print(f"{path.name:28} {path.stat().st_size / 1e6:.1f} MB")  # [en]
    print(f"{path.name:28} {path.stat().st_size / 1e6:.1f} Mo")  # [fr]
continued = load_all(folder, make_parking(seed=1))
continued.learn(steps(8_000), reset_num_timesteps=False)
print(continued.num_timesteps)
continued.evaluate(episodes=50)

# %% [markdown] lang="en"
# ## 7. Resuming exactly
#
# Was the last training the same as if it had never been interrupted? No: new episodes began, and the random numbers
# were others. For that there are *checkpoints*. Below, a run of 1,000 steps on Pendulum is interrupted at step 600
# and resumed, and compared with a run that was not interrupted. **Before you run the cell:** which of the two,
# checkpoint or model and buffer, gives exactly the same actions as the uninterrupted run?

# %% [markdown] lang="fr"
# ## 7. Reprendre exactement
#
# Ce dernier entraînement était-il le même que s'il n'avait jamais été interrompu ? Non : de nouveaux épisodes ont
# commencé, et les nombres aléatoires étaient autres. C'est à cela que servent les *checkpoints* (points de reprise).
# Ci-dessous, un entraînement de 1 000 pas sur Pendulum est interrompu au pas 600, puis repris, et comparé à un
# entraînement sans interruption. **Avant de lancer la cellule :** lequel des deux, checkpoint ou modèle et mémoire,
# donne exactement les mêmes actions que l'entraînement sans interruption ?

# %%
total, cut = steps(1_000), steps(600)
small = {"learning_starts": 100, "batch_size": 64, "policy_kwargs": {"net_arch": [32, 32]}, "seed": 0}
states = np.stack([np.cos(x := np.linspace(0, 6, 20)), np.sin(x), 0 * x], axis=1).astype(np.float32)


def interruption(agent, progress):
    """Stops the training, in place of a power cut."""  # [en]
    """Arrête l'entraînement, à la place d'une panne de courant."""  # [fr]
    return progress.step < cut


whole = rejeu.SAC("MlpPolicy", "Pendulum-v1", **small).learn(total)

interrupted = rejeu.SAC("MlpPolicy", "Pendulum-v1", **small)
interrupted.learn(total, callback=[interruption, Checkpoint(folder / "checkpoints", every=total)])
resumed = rejeu.SAC.resume(folder / "checkpoints")
resumed.learn()

(folder / "pendulum").mkdir()
save_all(interrupted, folder / "pendulum")
loaded = load_all(folder / "pendulum", "Pendulum-v1")
loaded.learn(total - cut)

expected = whole.predict(states, deterministic=True)[0]
names = "checkpoint", "model and buffer"  # [en]
names = "checkpoint", "modèle et mémoire"  # [fr]
for name, agent in zip(names, (resumed, loaded), strict=True):
    difference = np.abs(agent.predict(states, deterministic=True)[0] - expected).max()
    print(f"{name:18} largest difference of the actions: {difference:.6f}")  # [en]
    print(f"{name:18} plus grand écart entre les actions : {difference:.6f}")  # [fr]

# %% [markdown] lang="en" role="answer"
# *Answer.* The checkpoint: the difference is exactly 0. It contains all that the training depends on: the parameters,
# the optimizers, the replay buffer, the running episode with the state of the environment, the random numbers and the
# counters. The model and the buffer lack the running episode and the random numbers. Such a training is as good as
# the other, but it is another one. Exactness is worth having when a result must be reproduced, or an error found.

# %% [markdown] lang="fr" role="answer"
# *Réponse.* Le checkpoint : l'écart est exactement 0. Il contient tout ce dont dépend l'entraînement : les
# paramètres, les optimiseurs, la mémoire de rejeu, l'épisode en cours avec l'état de l'environnement, les nombres
# aléatoires et les compteurs. Au modèle et à la mémoire, il manque l'épisode en cours et les nombres aléatoires. Un
# tel entraînement vaut l'autre, mais c'en est un autre. L'exactitude est précieuse quand il faut reproduire un
# résultat, ou trouver une erreur.

# %% [markdown] lang="en"
# ## 8. A video
#
# `record_video` plays episodes with the deterministic policy. What do you see in the episodes that fail?

# %% [markdown] lang="fr"
# ## 8. Une vidéo
#
# `record_video` joue des épisodes avec la politique déterministe. Que voyez-vous dans les épisodes qui échouent ?

# %%
rejeu.record_video(continued, folder / "parking.mp4", episodes=4, max_steps=200, seed=3)
rejeu.show_videos(folder)

# %% [markdown] lang="en"
# ## 9. To go further
#
# - Vary `n_sampled_goal`: 0, 1, 4, 16. With 0 there is no hindsight, with 16 the real goals become rare. Use three
#   seeds each.
# - Write a strategy `near` that takes goals at most five steps after the step, and compare it with `future` on the
#   bits.
# - Make parking's reward rare, with a wrapper: 0 for a success, else -1. Which agents still learn?

# %% [markdown] lang="fr"
# ## 9. Pour aller plus loin
#
# - Faites varier `n_sampled_goal` : 0, 1, 4, 16. Avec 0, il n'y a plus de HER ; avec 16, les vrais buts deviennent
#   rares. Prenez trois graines pour chacun.
# - Écrivez une stratégie `near`, qui prend des buts au plus cinq pas après le pas, et comparez-la à `future` sur les
#   bits.
# - Rendez rare la récompense du parking avec un *wrapper* : 0 en cas de réussite, sinon -1. Quels agents apprennent
#   encore ?
