
const agent = makeAgent(), actions = [], seconds = [];
for (const [observations, start] of JSON.parse(require("fs").readFileSync(0, "utf8"))) {
  const begin = process.hrtime.bigint();
  const action = agent(observations, start);
  seconds.push(Number(process.hrtime.bigint() - begin) * 1e-9);
  actions.push(Array.from(action));
}
console.log(JSON.stringify([actions, seconds]));
