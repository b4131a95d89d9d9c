// Pictures that change many times a second, side by side, with texts, which become text nodes. They come over a websocket of
// their own: a text with the captions, then a JPEG for each. Keys go back on it.
export default {
  template: `<div class="screen" ref="screen" tabindex="0">
    <figure v-for="(one, i) in captions" :key="i" :class="{won: one.won}">
      <figcaption><b>{{ one.name }}</b><span>{{ one.score }}</span><small>{{ one.about }}</small></figcaption>
      <canvas :ref="(canvas) => { canvases[i] = canvas }" role="img" :aria-label="one.name + ' ' + one.score"></canvas>
      <p>{{ one.message }}</p>
      <div v-for="bar in one.bars || []" class="bar" :class="{chosen: bar.is_chosen}"><span>{{ bar.name }}</span>
        <div><i :style="{left: bar.start * 100 + '%', width: Math.max(bar.end - bar.start, 0.005) * 100 + '%'}"></i>
          <b v-if="bar.mark !== null" :style="{left: bar.mark * 100 + '%'}"></b></div><span>{{ bar.text }}</span></div>
    </figure></div>`,
  props: { channel: String, keys: Boolean },
  data: () => ({ captions: [] }),
  mounted() {
    this.canvases = [];
    this.labels = {};
    this.open();
    this.listening = new AbortController();
    const { signal } = this.listening;
    if (!this.keys) return;
    window.addEventListener("keydown", (event) => this.key("press", event), { signal });
    window.addEventListener("keyup", (event) => this.key("release", event), { signal });
    navigator.keyboard?.getLayoutMap?.().then((map) => this.learn(Object.fromEntries(map)), () => {});
    window.addEventListener("blur", () => this.send(["leave", ""]), { signal });
  },
  beforeUnmount() {
    this.listening.abort();
    this.closed = true;
    this.socket.close();
  },
  methods: {
    open() {
      const pictures = [];
      let texts = null;
      this.socket = new WebSocket(`${location.protocol === "https:" ? "wss" : "ws"}://${location.host}/screen/${this.channel}`);
      this.socket.binaryType = "blob";
      this.socket.onmessage = async ({ data }) => {
        if (typeof data === "string") texts = JSON.parse(data);
        else pictures.push(createImageBitmap(data));
        if (!texts || pictures.length < texts.captions.length) return;
        const { captions, presses } = texts;
        texts = null;
        const drawn = await Promise.all(pictures.splice(0));
        this.captions = captions;
        await this.$nextTick();
        drawn.forEach((picture, i) => this.draw(this.canvases[i], picture));
        this.$refs.screen.dataset.presses = presses; // how many keys these pictures have taken
        this.send(["shown", ""]);
      };
      this.socket.onclose = ({ code }) => this.closed || code === 1008 || setTimeout(() => this.open(), 500);
    },
    draw(canvas, picture) {
      if (!canvas) return;
      if (canvas.width !== picture.width || canvas.height !== picture.height) {
        canvas.width = picture.width;
        canvas.height = picture.height;
        canvas.classList.toggle("small", picture.height < 270);
      }
      canvas.getContext("2d").drawImage(picture, 0, 0);
      picture.close();
    },
    send(message) {
      if (this.socket.readyState === WebSocket.OPEN) this.socket.send(JSON.stringify(message));
    },
    learn(labels) { // what stands on the keys, which browsers without a map of them show one by one
      if (Object.entries(labels).every(([code, label]) => this.labels[code] === label)) return;
      this.labels = { ...this.labels, ...labels };
      this.$emit("labels", this.labels);
    },
    key(kind, event) {
      if (event.ctrlKey || event.metaKey || event.altKey || event.target.closest("input, textarea, select, [role=listbox]")) return;
      if (["ArrowLeft", "ArrowRight", "ArrowUp", "ArrowDown", " ", "Enter"].includes(event.key)) {
        if (event.target.closest("button, a") && event.key === "Enter") return;
        event.preventDefault(); // the page would scroll
        event.target.closest("button")?.blur();
      }
      if (event.code && event.key.length === 1 && event.key !== " ") this.learn({ [event.code]: event.key.toLowerCase() });
      if (!event.repeat) this.send([kind, event.code || event.key]); // the place of a key, not its letter
    },
  },
};
