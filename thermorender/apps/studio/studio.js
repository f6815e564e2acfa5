// The parts of the page that answer a hand at once: turning the picture, the pixel under it, dragging a spectrum.
window.studio = {
  arrows: { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] },
  version: 0,
  picture: null, // {shown, loading, waiting}: the latest picture wins
  setUp() {
    const image = document.getElementById("frame");
    if (!image || image.dataset.ready) return;
    image.dataset.ready = "yes";
    const at = (e) => {
      const box = image.getBoundingClientRect();
      return [
        Math.floor(((e.clientX - box.left) / box.width) * image.naturalWidth),
        Math.floor(((e.clientY - box.top) / box.height) * image.naturalHeight),
      ];
    };
    let drag = null, sum = [0, 0], busy = 0, zoom = 1, hovered = 0;
    const send = () => {
      const now = performance.now();
      if (now - busy < 250 && studio.picture.loading) return;
      if (!sum[0] && !sum[1] && zoom === 1) return;
      busy = now;
      emitEvent("studio_move", { right: sum[0], down: sum[1], pan: drag ? drag.pan : false, zoom });
      sum = [0, 0];
      zoom = 1;
    };
    studio.sendMoves = send;
    image.addEventListener("pointerdown", (e) => {
      image.setPointerCapture(e.pointerId);
      drag = { x: e.clientX, y: e.clientY, far: 0, pan: e.shiftKey || e.button === 2 };
    });
    image.addEventListener("contextmenu", (e) => e.preventDefault());
    image.addEventListener("pointermove", (e) => {
      if (drag) {
        const box = image.getBoundingClientRect();
        const dx = (e.clientX - drag.x) / box.width, dy = (e.clientY - drag.y) / box.width;
        drag.far += Math.abs(dx) + Math.abs(dy);
        drag.x = e.clientX;
        drag.y = e.clientY;
        sum = [sum[0] + dx, sum[1] + dy];
        if (drag.far > 0.01) send();
      } else if (performance.now() - hovered > 120) {
        hovered = performance.now();
        emitEvent("studio_hover", at(e));
      }
    });
    image.addEventListener("pointerup", (e) => {
      if (drag && drag.far <= 0.01) {
        sum = [0, 0];
        emitEvent("studio_pick", at(e));
      } else {
        busy = 0;
        send();
      }
      drag = null;
    });
    image.addEventListener("wheel", (e) => {
      e.preventDefault();
      zoom *= Math.exp(0.0015 * e.deltaY);
      send();
    }, { passive: false });
    image.addEventListener("keydown", (e) => {
      const [right, down] = studio.arrows[e.key] || [0, 0], zoom = { "+": 0.8, "-": 1.25 }[e.key] || 1;
      if (!right && !down && zoom === 1) return;
      e.preventDefault();
      emitEvent("studio_move", { right: 0.04 * right, down: 0.04 * down, pan: e.shiftKey, zoom });
    });
  },
  say(words, exact) {
    const state = document.getElementById("state");
    state.textContent = words;
    state.classList.toggle("preview", !exact);
  },
  show(source, version, number, words, exact) {
    const image = document.getElementById("frame");
    if (!image) return;
    const state = (studio.picture = studio.picture || { loading: false, waiting: null });
    if (state.loading) {
      state.waiting = [source, version, number, words, exact];
      return;
    }
    state.loading = true;
    const done = (ok) => {
      state.loading = false;
      if (ok) {
        image.dataset.version = version;
        image.dataset.number = number;
        studio.say(words, exact);
        window.dispatchEvent(new CustomEvent("studio-shown", { detail: { version, number } }));
      }
      if (state.waiting) {
        const next = state.waiting;
        state.waiting = null;
        studio.show(...next);
      } else if (studio.sendMoves) studio.sendMoves();
    };
    image.onload = () => done(true);
    image.onerror = () => done(false);
    image.src = source;
  },
  // Makes the handles of a spectrum draggable. `limits` are those of the emissivity axis.
  spectrum(id, series) {
    const chart = getElement(id).chart;
    if (!chart) return setTimeout(() => studio.spectrum(id, series), 30);
    if (chart.studioReady) return;
    chart.studioReady = true;
    const zr = chart.getZr();
    let held = null;
    const points = () => (chart.getOption().series[series] || { data: [] }).data;
    zr.on("mousedown", (e) => {
      let best = 14;
      held = null;
      points().forEach((point, k) => {
        const [x, y] = chart.convertToPixel({ seriesIndex: series }, point);
        const far = Math.hypot(x - e.offsetX, y - e.offsetY);
        if (far < best) [best, held] = [far, { k, wavelength: point[0], value: point[1] }];
      });
    });
    zr.on("mousemove", (e) => {
      if (!held) return;
      const y = chart.convertFromPixel({ seriesIndex: series }, [e.offsetX, e.offsetY])[1];
      held.value = Math.min(1, Math.max(0, y));
      held.moved = true;
      const data = points().map((point, k) => (k === held.k ? [point[0], held.value] : point));
      const all = chart.getOption().series.map(() => ({}));
      all[series] = { data };
      chart.setOption({ series: all });
    });
    zr.on("mouseup", () => {
      if (held && held.moved)
        emitEvent("studio_spectrum", { wavelength: held.wavelength, value: held.value, version: studio.version });
      held = null;
    });
    zr.on("globalout", () => { held = null; });
  },
  // The map: areas are drawn in shares of its width and height.
  setUpMap() {
    const image = document.getElementById("map"), box = document.getElementById("mapstage");
    if (!box || box.dataset.ready) return;
    box.dataset.ready = "yes";
    let points = [], held = false, mark = [0.5, 0.5];
    const at = (e) => {
      const r = image.getBoundingClientRect();
      return [(e.clientX - r.left) / r.width, (e.clientY - r.top) / r.height];
    };
    const draw = () => {
      document.getElementById("mapdraw").innerHTML = `<circle cx="${mark[0]}" cy="${mark[1]}" r="0.008"/>` +
        [...studio.labels, points]
          .map((ring) => `<polygon points="${ring.map((p) => p.join(",")).join(" ")}" vector-effect="non-scaling-stroke"/>`)
          .join("");
    };
    const send = () => {
      const tool = studio.mapTool;
      if (tool === "fill" ? points.length === 1 : points.length > 2)
        emitEvent("studio_area", { tool, points, version: studio.version });
      points = [];
      draw();
    };
    box.addEventListener("pointerdown", (e) => {
      if (e.button) return;
      held = true;
      if (studio.mapTool === "lasso") points = [];
      if (studio.mapTool !== "polygon") points = [at(e)];
      else if (e.detail < 2) points.push(at(e));
      draw();
    });
    box.addEventListener("pointermove", (e) => {
      if (held && studio.mapTool === "lasso") points.push(at(e)), draw();
    });
    box.addEventListener("pointerup", () => {
      held = false;
      if (studio.mapTool !== "polygon") send();
    });
    box.addEventListener("dblclick", () => { if (studio.mapTool === "polygon") send(); });
    // Without a mouse: arrows move the mark, Space puts a corner there, Enter closes the area, Escape drops it.
    box.addEventListener("keydown", (e) => {
      const [right, down] = studio.arrows[e.key] || [0, 0], step = e.shiftKey ? 0.002 : 0.02;
      if (right || down) mark = [mark[0] + step * right, mark[1] + step * down].map((v) => Math.min(1, Math.max(0, v)));
      else if (e.key === " ") points = [...points, mark];
      else if (e.key === "Escape") points = [];
      else if (e.key !== "Enter") return;
      e.preventDefault();
      if (e.key === "Enter" || (e.key === " " && studio.mapTool === "fill")) send();
      else draw();
    });
    studio.clearMap = () => { points = []; draw(); };
  },
  labels: [],
  showLabels(rings) {
    studio.labels = rings;
    if (studio.clearMap) studio.clearMap();
  },
  tool(name) {
    studio.mapTool = name;
    if (studio.clearMap) studio.clearMap();
  },
  showMap(source, version) {
    const image = document.getElementById("map");
    if (!image) return;
    image.onload = () => { image.dataset.version = version; };
    image.src = source;
  },
};
