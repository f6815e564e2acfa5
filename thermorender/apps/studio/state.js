// What the page knows of the picture and of the edits: what is said beside a picture belongs to that picture.
window.studio = {
  version: 0, // of the tables, on which an edit is based
  latest: 0, // of the edits
  picture: null, // what is shown
  work: null, // {version, share, ended} of the latest solution
  look: 0, // views that were asked for
  waits: ["", ""], // why the view that was asked for waits for a solution: after an edit, and without one
  toTell: {}, // what is said of a picture that has not arrived yet
  waiting: 0, // edits that the studio has not answered
  online: true,
  byId: (id) => document.getElementById(id),
  setUp() {
    if (!studio.byId("frame") || studio.ready) return;
    studio.ready = true;
    studio.setUpHand();
    const link = window.socket;
    link.on("disconnect", () => studio.connected(false));
    link.on("connect", () => studio.connected(true));
    window.addEventListener("offline", () => studio.connected(false));
    window.addEventListener("online", () => studio.connected(link.connected));
    const dark = window.matchMedia("(prefers-color-scheme: dark)");
    const themed = () => emitEvent("studio_theme", dark.matches);
    dark.addEventListener("change", themed);
    themed();
    window.addEventListener("popstate", () =>
      emitEvent("studio_address", Object.fromEntries(new URLSearchParams(location.search))));
  },
  connected(online) {
    studio.online = online;
    if (online && studio.failed) studio.load(studio.failed);
    studio.say();
  },
  // Sends an edit with `emit`, and waits until the studio has answered.
  sent(emit, ...given) {
    emit(...given);
    const number = ++studio.waiting;
    studio.say();
    setTimeout(() => emitEvent("studio_heard", number), 0);
  },
  // Sends an edit once a hand has held still, such as on a slider.
  held(emit, value) {
    clearTimeout(studio.holding);
    studio.holding = setTimeout(() => {
      studio.holding = null;
      studio.sent(emit, value, studio.version);
    }, 300);
    studio.say();
  },
  heard(number) {
    studio.answered = number;
    studio.say();
  },
  at(version) {
    studio.latest = version;
    studio.say();
  },
  asked(look, waits) {
    studio.look = look;
    studio.waits = waits;
    studio.say();
  },
  working(version, share) {
    studio.work = { version, share: share ?? 1, ended: share === null };
    studio.say();
  },
  fault(version) {
    studio.faulty = version;
    studio.work = null;
    studio.say();
  },
  // The words of the state: they are about the picture that is shown.
  words() {
    const shown = studio.picture;
    const work = studio.work && studio.work.version === studio.latest ? studio.work : null;
    const share = work && !work.ended ? work.share : null;
    const solving = `solving ${Math.floor(100 * (work ? work.share : 0))} %`;
    if (!studio.online) return ["offline", "off"];
    if (studio.holding || studio.waiting !== (studio.answered ?? 0)) return ["sending …", "preview"];
    if (studio.faulty === studio.latest) return ["not rendered", "off"];
    if (!shown) return [share === null ? "rendering …" : solving, "preview"];
    if (shown.version !== studio.latest) {
      const coming = studio.loading || studio.failed;
      return [coming && coming.version === studio.latest ? "loading …" : solving, "preview"];
    }
    if (shown.look !== studio.look && share === null) return ["rendering …", "preview"];
    if (!shown.exact) return [share === null ? shown.words : `${shown.words} · ${solving}`, "preview"];
    return share === null ? [shown.words, ""] : [`comparison: ${solving}`, "preview"];
  },
  say() {
    const state = studio.byId("state"), shown = studio.picture, [words, kind] = studio.words();
    if (!state) return;
    if (state.textContent !== words) state.textContent = words;
    state.className = `state nicegui-html ${kind}`;
    const stale = !!shown && shown.version !== studio.latest;
    studio.byId("version").textContent = shown ? `version ${shown.version}` : "";
    const mark = studio.byId("stale"), working = studio.work && !studio.work.ended;
    const waits = stale ? studio.waits[0] : shown && working && shown.look !== studio.look ? studio.waits[1] : "";
    mark.hidden = !stale && !waits;
    mark.textContent = [stale ? `version ${shown.version}, before the edit` : "", waits].filter(Boolean).join("; ");
    studio.byId("stage").classList.toggle("before", stale || !!waits);
    studio.byId("hover").classList.toggle("before", !!studio.hoverTold && (stale || studio.hoverTold !== shown.number));
    studio.byId("cards").classList.toggle("before", stale || !shown || studio.told !== shown.number);
  },
  // Shows a picture with all that belongs to it, once it has arrived; the latest one wins.
  show(given) {
    if (studio.loading && studio.loading.number > given.number) return;
    studio.load(given);
  },
  async load(given) {
    studio.loading = given;
    studio.failed = null;
    studio.say();
    const fetched = async (source) => {
      const answer = await fetch(source);
      if (!answer.ok) return answer.status === 404 ? null : Promise.reject(new Error(answer.status));
      const address = URL.createObjectURL(await answer.blob());
      const probe = new Image();
      probe.src = address;
      await probe.decode();
      return address;
    };
    try {
      const [one, other] = await Promise.all([fetched(given.source), given.other ? fetched(given.other) : ""]);
      // Of a picture that is not there any more, the next one is on its way.
      if (one && other !== null && studio.loading === given) studio.place(given, one, other);
    } catch (error) {
      if (studio.loading === given) {
        studio.failed = given;
        setTimeout(() => { if (studio.failed === given && studio.online) studio.load(given); }, 1000);
      }
    }
    if (studio.loading === given) studio.loading = null;
    if (studio.sendMoves) studio.sendMoves();
  },
  place(given, one, other) {
    const image = studio.byId("frame"), beside = studio.byId("other");
    for (const each of [image, beside]) if (each.src.startsWith("blob:")) URL.revokeObjectURL(each.src);
    image.src = one;
    if (other) beside.src = other;
    else beside.removeAttribute("src");
    for (const id of ["other", "slider", "sides"]) studio.byId(id).hidden = !other;
    if (other) {
      studio.byId("side-a").textContent = given.sides[0];
      studio.byId("side-b").textContent = given.sides[1];
      studio.slide();
    }
    studio.byId("outline").hidden = true;
    // Corners of a polygon belong to the places that they were put on.
    if (studio.picture && studio.picture.place !== given.place && studio.points.length) {
      studio.points = [];
      studio.draw();
    }
    studio.picture = given;
    if (given.version === studio.latest) studio.faulty = null;
    Object.assign(image.dataset, { version: given.version, number: given.number });
    const scale = studio.byId("scale");
    scale.style.visibility = given.gradient ? "visible" : "hidden";
    scale.querySelector(".unit").textContent = given.unit;
    scale.querySelector(".colours").style.background = given.gradient || "none";
    scale.querySelector(".ticks").replaceChildren(...given.ticks.map((text) => studio.made("div", text)));
    studio.byId("title").textContent = given.title;
    if (!studio.hoverTold) studio.byId("hover").textContent = given.hint;
    studio.byId("notes").textContent = given.notes;
    studio.byId("legend").replaceChildren(...given.legend.map(([name, colour]) => studio.swatched(name, colour)));
    studio.say();
    for (const told of Object.values(studio.toTell)) if (told.number === given.number) studio.describe(told);
    if (studio.toOutline && studio.toOutline[1] === given.number) studio.outline(...studio.toOutline);
    window.dispatchEvent(new CustomEvent("studio-shown", { detail: { version: given.version, number: given.number } }));
  },
  slide() {
    const share = studio.byId("slider").value;
    studio.byId("other").style.clipPath = `inset(0 0 0 ${share}%)`;
    studio.byId("sides").style.setProperty("--share", `${share}%`);
  },
  outline(source, number) {
    const image = studio.byId("outline");
    if (!studio.picture || studio.picture.number !== number) {
      studio.toOutline = [source, number];
      return;
    }
    image.onload = () => { image.hidden = !studio.picture || studio.picture.number !== number; };
    image.src = source;
  },
  made(kind, text = "", about = {}) {
    const element = document.createElement(kind);
    element.textContent = text;
    for (const [name, value] of Object.entries(about)) element.setAttribute(name, value);
    return element;
  },
  swatched(name, colour) {
    const row = studio.made("div");
    row.append(studio.made("span", "", { class: "swatch", style: `background:${colour}` }), studio.made("span", name));
    return row;
  },
  // What is said of a picture: only of the one that is shown.
  describe(told) {
    if (!studio.picture || studio.picture.number !== told.number) {
      // Of a picture that has not arrived yet.
      if (told.number > (studio.picture ? studio.picture.number : 0)) studio.toTell[told.table ? "cards" : "hover"] = told;
      return;
    }
    if (told.hover) {
      studio.byId("hover").textContent = told.hover;
      studio.hoverTold = told.number;
      studio.say();
    }
    if (!told.table) return;
    studio.told = told.number;
    const made = studio.made;
    if (told.figures) {
      const figures = studio.byId("figures");
      figures.dataset.version = told.version;
      figures.classList.toggle("both", told.sides.length > 0);
      const head = told.sides.length ? ["", ...told.sides].map((text) => made("div", text, { class: "k" })) : [];
      figures.replaceChildren(...head, ...told.figures.flatMap(([key, value, other]) => [
        made("div", key, { class: "k" }),
        made("div", value, { "data-key": key, class: other === undefined ? "across" : "" }),
        ...(other === undefined ? [] : [made("div", other, { "data-other": key })])]));
      const keep = made("button", "Keep this point", { type: "button", class: "plain", "data-testid": "keep" });
      keep.onclick = () => emitEvent("studio_keep");
      if (told.figures.some(([key]) => key === "Material")) figures.append(keep);
    }
    const parts = studio.byId("parts");
    parts.replaceChildren();
    if (told.parts && told.parts.length) {
      const box = made("div", "", { class: "figures three" });
      box.append(...["", "W m⁻² sr⁻¹", "K less without"].map((text) => made("div", text, { class: "k r" })));
      for (const [name, words, radiance, kelvin] of told.parts)
        box.append(made("div", words, { class: "k" }), made("div", radiance, { class: "r", "data-part": name }),
          made("div", kelvin, { class: "r" }));
      parts.append(made("h2", "Radiance by origin"), box);
    }
    const heat = studio.byId("heat");
    heat.replaceChildren();
    if (told.heat && told.heat.length) {
      const box = made("div", "", { class: told.sides.length ? "figures two both" : "figures two" });
      if (told.sides.length) box.append(...["", ...told.sides].map((text) => made("div", text, { class: "k r" })));
      for (const [words, value, ...other] of told.heat)
        box.append(made("div", words, { class: "k" }), made("div", value, { class: "r", "data-heat": words }),
          ...other.map((text) => made("div", text, { class: "r" })));
      heat.append(made("h2", "Heat balance, gains above 0"), box);
    }
    const rows = (id, title, heads, list, cells) => {
      const box = studio.byId(id);
      box.replaceChildren();
      if (!list.length) return;
      const table = made("table"), head = made("tr");
      head.append(...heads.map((text) => made("th", text, { scope: "col" })));
      table.append(head, ...list.map((row) => { const line = made("tr"); line.append(...cells(row)); return line; }));
      box.append(made("h2", title), table);
    };
    rows("probes", "Kept points", ["point", "material", "apparent", "kinetic", "shown", ""], told.probes, (row) => {
      const drop = made("button", "remove", { type: "button", class: "plain", "aria-label": `Remove point ${row[0]}` });
      drop.onclick = () => emitEvent("studio_drop", row[0]);
      const last = made("td");
      last.append(drop);
      return [...row.map((text) => made("td", text)), last];
    });
    rows("table", "Materials in view", ["material", "pixels", "mean", "least", "greatest", "area from above"], told.table,
      ([name, colour, ...texts]) => {
        const choose = made("button", name, { type: "button", class: "plain" }), first = made("td");
        choose.onclick = () => emitEvent("studio_choose", name);
        first.append(made("span", "", { class: "swatch", style: `background:${colour}` }), choose);
        return [first, ...texts.map((text) => made("td", text, { class: "r" }))];
      });
    studio.byId("marks").replaceChildren(...told.marks.map(([x, y, name]) =>
      made("div", name, { class: name ? "cross named" : "cross", style: `left:${100 * x}%;top:${100 * y}%` })));
    studio.say();
  },
  address(query, fresh) {
    const address = `${location.pathname}?${query}`;
    if (address === location.pathname + location.search) return;
    history[fresh ? "pushState" : "replaceState"](null, "", address);
  },
};
