// The parts of the page that answer a hand at once: turning the picture, the pixel under it, strokes of a tool.
Object.assign(studio, {
  arrows: { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] },
  tool: "look",
  radius: 8, // of the brush [px]
  points: [], // of the stroke under way, as shares of the picture
  mark: [0.5, 0.5], // moved by arrow keys
  use(tool, radius) {
    const changed = tool !== studio.tool;
    studio.tool = tool;
    studio.radius = radius;
    if (changed) studio.points = [];
    const stage = studio.byId("stage");
    if (!stage) return;
    stage.dataset.tool = tool;
    studio.draw();
  },
  draw() {
    const image = studio.byId("frame"), box = studio.byId("draw");
    const line = studio.points.map((point) => point.join(",")).join(" ");
    const wide = (2 * studio.radius) / (image.naturalWidth || 640);
    const shape = { brush: `<polyline points="${line}" class="brush" stroke-width="${wide}"/>`,
      polygon: `<polygon points="${line}" vector-effect="non-scaling-stroke"/>` }[studio.tool] || "";
    const marked = studio.marking ? `<circle cx="${studio.mark[0]}" cy="${studio.mark[1]}" r="0.01"/>` : "";
    box.innerHTML = shape + marked;
  },
  setUpHand() {
    const image = studio.byId("frame"), stage = studio.byId("stage"), slider = studio.byId("slider");
    const share = (e) => {
      const box = image.getBoundingClientRect();
      return [(e.clientX - box.left) / box.width, (e.clientY - box.top) / box.height];
    };
    const pixel = ([x, y]) => [Math.floor(x * image.naturalWidth), Math.floor(y * image.naturalHeight)];
    const send = () => {
      const now = performance.now();
      if (now - busy < 250 && studio.loading) return;
      if (!sum[0] && !sum[1] && zoom === 1) return;
      busy = now;
      emitEvent("studio_move", { right: sum[0], down: sum[1], pan: drag ? drag.pan : false, zoom });
      sum = [0, 0];
      zoom = 1;
    };
    const stroke = () => {
      const tool = studio.tool;
      // The second press of a double click puts its corner again.
      const apart = (one, other) => Math.hypot(one[0] - other[0], one[1] - other[1]) > 0.004;
      const points = tool !== "polygon" ? studio.points
        : studio.points.filter((point, k, all) => !k || apart(point, all[k - 1]));
      studio.points = [];
      studio.draw();
      if (points.length)
        studio.sent(emitEvent, "studio_stroke", { tool, points, version: studio.version, number: studio.picture.number });
    };
    const paints = () => studio.tool !== "look" && studio.tool !== "point";
    let drag = null, sum = [0, 0], busy = 0, zoom = 1, hovered = 0;
    studio.sendMoves = send;
    slider.addEventListener("input", studio.slide);
    image.addEventListener("contextmenu", (e) => e.preventDefault());
    image.addEventListener("pointerdown", (e) => {
      if (e.button && studio.tool !== "look") return;
      image.setPointerCapture(e.pointerId);
      studio.marking = false;
      drag = { x: e.clientX, y: e.clientY, far: 0, pan: e.shiftKey || e.button === 2 };
      if (!paints()) return;
      if (studio.tool === "polygon") studio.points.push(share(e));
      else studio.points = [share(e)];
      studio.draw();
    });
    image.addEventListener("pointermove", (e) => {
      if (drag && paints()) {
        if (studio.tool === "brush") studio.points.push(share(e)), studio.draw();
      } else if (drag) {
        const box = image.getBoundingClientRect();
        const dx = (e.clientX - drag.x) / box.width, dy = (e.clientY - drag.y) / box.width;
        drag.far += Math.abs(dx) + Math.abs(dy);
        [drag.x, drag.y] = [e.clientX, e.clientY];
        sum = [sum[0] + dx, sum[1] + dy];
        if (drag.far > 0.01 && studio.tool === "look") send();
      } else if (performance.now() - hovered > 120) {
        hovered = performance.now();
        emitEvent("studio_hover", pixel(share(e)));
      }
    });
    image.addEventListener("pointerup", (e) => {
      if (!drag) return;
      if (paints()) {
        if (studio.tool !== "polygon") stroke();
      } else if (drag.far <= 0.01) {
        sum = [0, 0];
        emitEvent("studio_pick", [...pixel(share(e)), studio.picture.number]);
      } else if (studio.tool === "look") {
        busy = 0;
        send();
      }
      drag = null;
    });
    image.addEventListener("dblclick", () => { if (studio.tool === "polygon") stroke(); });
    image.addEventListener("wheel", (e) => {
      e.preventDefault();
      zoom *= Math.exp(0.0015 * e.deltaY);
      send();
    }, { passive: false });
    // Without a mouse: arrows turn the view or move the mark; Enter picks or paints there; Space puts a corner.
    image.addEventListener("keydown", (e) => {
      const [right, down] = studio.arrows[e.key] || [0, 0], nearer = { "+": 0.8, "-": 1.25 }[e.key] || 1;
      if (studio.tool === "look" || nearer !== 1) {
        if (!right && !down && nearer === 1) return;
        e.preventDefault();
        emitEvent("studio_move", { right: 0.04 * right, down: 0.04 * down, pan: e.shiftKey, zoom: nearer });
        return;
      }
      const step = (e.shiftKey ? 1 : 12) / (image.naturalWidth || 640);
      if (right || down)
        studio.mark = [studio.mark[0] + step * right, studio.mark[1] + step * down].map((v) => Math.min(0.999, Math.max(0, v)));
      else if (e.key === " ") studio.points = [...studio.points, studio.mark];
      else if (e.key === "Escape") studio.points = [];
      else if (e.key !== "Enter") return;
      e.preventDefault();
      studio.marking = e.key !== "Escape";
      if (studio.tool === "point") {
        emitEvent("studio_hover", pixel(studio.mark));
        if (e.key === "Enter" || e.key === " ") emitEvent("studio_pick", [...pixel(studio.mark), studio.picture.number]);
      } else if (e.key === "Enter" || (e.key === " " && studio.tool !== "polygon" && studio.tool !== "brush")) {
        if (!studio.points.length) studio.points = [studio.mark];
        stroke();
      }
      studio.draw();
    });
    // Text that is typed and not confirmed has the browser's own undo.
    document.addEventListener("input", (e) => { e.target.typed = true; }, true);
    document.addEventListener("change", (e) => { e.target.typed = false; }, true);
    document.addEventListener("keydown", (e) => {
      const letter = e.key.toLowerCase();
      if (!(e.ctrlKey || e.metaKey) || e.altKey || !"zy".includes(letter) || e.target.typed) return;
      if (document.querySelector(".q-dialog")) return;
      e.preventDefault();
      const by = letter === "y" || e.shiftKey ? 1 : -1;
      studio.sent(emitEvent, "studio_step", { version: studio.version, by });
    });
    studio.use(studio.tool, studio.radius);
  },
});
