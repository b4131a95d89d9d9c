function fmod(x, y) {
  return x % y;
}

function rint(x) {
  const low = Math.floor(x), rest = x - low;
  return rest < 0.5 || (rest === 0.5 && low % 2 === 0) ? low : low + 1;
}

/* Returns an agent: a function from observations, and whether an episode starts, to an action. */
function makeAgent() {
  let memory = ABOUT.memory.map((n) => new Float32Array(n));
  return (observations, start) => {
    const recurrent = memory.length ? [...memory, [start ? 1 : 0]] : [];
    const found = policy(...observations, ...recurrent);
    memory = found.slice(1);
    return found[0];
  };
}

function drawNumbers(kinds) {
  const normal = () => Math.sqrt(-2 * Math.log(1 - Math.random())) * Math.cos(2 * Math.PI * Math.random());
  return kinds.map(([kind, n]) => Float32Array.from({ length: n }, kind === "normal" ? normal : Math.random));
}

function parts(found) {
  const n = ABOUT.n_state;
  return { state: found.slice(0, n), observations: found.slice(n, n + ABOUT.n_obs), rest: found.slice(n + ABOUT.n_obs) };
}

/* Returns a new episode; the draws make it the same for both players. */
function startEpisode(draws) {
  const { state, observations } = parts(resetWorld(...draws));
  return { state, observations, score: 0, steps: 0, isOver: false };
}

function stepEpisode(episode, action, draws) {
  const { state, observations, rest } = parts(stepWorld(...episode.state, action, ...draws));
  const [[reward], [terminated], [truncated]] = rest;
  return {
    state, observations, score: episode.score + reward, steps: episode.steps + 1, isOver: Boolean(terminated || truncated),
  };
}
