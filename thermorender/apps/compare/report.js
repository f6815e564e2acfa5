// Red and green of a picture are the high and low byte of temperature in steps of 1/20 K; blue marks scored pixels.
const views = JSON.parse(document.getElementById("views").textContent);
const maps = JSON.parse(document.getElementById("colours").textContent);
const viewer = document.querySelector(".viewer"), chooser = document.getElementById("pose");
const mode = document.getElementById("mode"), kelvin = document.getElementById("kelvin");
let shown = [];

async function decoded(source) {
  const image = new Image();
  image.src = source;
  await image.decode();
  const canvas = document.createElement("canvas");
  canvas.width = image.width; canvas.height = image.height;
  const context = canvas.getContext("2d", { willReadFrequently: true, colorSpace: "srgb" });
  context.drawImage(image, 0, 0);
  const bytes = context.getImageData(0, 0, image.width, image.height).data;
  const values = new Float32Array(image.width * image.height), known = new Uint8Array(values.length);
  for (let k = 0; k < values.length; k++) {
    const step = bytes[4 * k] * 256 + bytes[4 * k + 1];
    values[k] = step ? step / 20 : NaN;
    known[k] = bytes[4 * k + 2] > 127;
  }
  return { width: image.width, height: image.height, values, known };
}

function range(values, known, share) {
  const kept = [...values].filter((value, k) => known[k] && isFinite(value)).sort((a, b) => a - b);
  if (!kept.length) return [0, 1];
  return [kept[Math.floor(share * (kept.length - 1))], kept[Math.ceil((1 - share) * (kept.length - 1))]];
}

function paint(each, valueAt, from, to, table) {
  const { width, height, values, known } = each.picture;
  each.canvas.width = width; each.canvas.height = height;
  const context = each.canvas.getContext("2d"), image = context.createImageData(width, height);
  for (let k = 0; k < values.length; k++) {
    const value = valueAt(k), step = Math.round((255 * (value - from)) / (to - from || 1));
    const colour = isFinite(value) && known[k] ? table[Math.max(0, Math.min(255, step))] : [136, 136, 136];
    image.data.set([...colour, 255], 4 * k);
  }
  context.putImageData(image, 0, 0);
}

function draw() {
  const truth = shown.find((each) => each.reference);
  const error = mode.value === "error" && truth !== undefined, own = mode.value === "own";
  // Without a reference, all pictures share one scale.
  const ends = (truth ? [truth] : shown).map((each) => range(each.picture.values, each.picture.known, 0.01));
  const cold = Math.min(...ends.map((each) => each[0])), warm = Math.max(...ends.map((each) => each[1]));
  let most = 1;
  if (error) {
    const off = [];
    for (const each of shown) {
      const { values, known } = each.picture;
      for (let k = 0; k < values.length; k += 7) {
        const value = Math.abs(values[k] - truth.picture.values[k]);
        if (!each.reference && known[k] && isFinite(value)) off.push(value);
      }
    }
    off.sort((a, b) => a - b);
    most = off.length ? off[Math.floor(0.95 * (off.length - 1))] : 1;
  }
  for (const each of shown) {
    const { values, known } = each.picture;
    const [least, greatest] = own ? range(values, known, 0.01) : [cold, warm];
    const limits = `, ${least.toFixed(1)}…${greatest.toFixed(1)} K`;
    each.caption.textContent = each.label + (own ? limits : "");
    if (error && !each.reference) paint(each, (k) => values[k] - truth.picture.values[k], -most, most, maps.error);
    else paint(each, (k) => values[k], least, greatest, maps.temperature);
  }
  const table = error ? maps.error : maps.temperature;
  const stops = [0, 64, 128, 192, 255].map((k) => `rgb(${table[k]})`).join(",");
  document.getElementById("scale").style.background = `linear-gradient(to right, ${stops})`;
  const limitWords = [cold, warm].map((kelvin) => (own ? "" : `${kelvin.toFixed(1)} K`));
  document.getElementById("low").textContent = error ? `−${most.toFixed(1)} K` : limitWords[0];
  document.getElementById("high").textContent = error ? `+${most.toFixed(1)} K` : limitWords[1];
}

async function show() {
  const view = views[chooser.value];
  viewer.replaceChildren();
  shown = [];
  const photograph = document.createElement("div");
  const image = new Image();
  image.src = view.visible;
  photograph.append(image, "photograph, registered");
  viewer.append(photograph);
  const pictures = await Promise.all(view.pictures.map((each) => decoded(each.source)));
  if (view !== views[chooser.value]) return;
  shown = view.pictures.map((each, k) => {
    const frame = document.createElement("div"), canvas = document.createElement("canvas");
    const caption = document.createElement("span");
    caption.textContent = each.label;
    frame.append(canvas, caption);
    viewer.append(frame);
    return { ...each, canvas, caption, picture: pictures[k] };
  });
  for (const each of shown) {
    each.canvas.addEventListener("mousemove", (event) => {
      const box = each.canvas.getBoundingClientRect(), { width, height, values } = each.picture;
      const column = Math.floor(((event.clientX - box.left) / box.width) * width);
      const row = Math.floor(((event.clientY - box.top) / box.height) * height), k = row * width + column;
      if (!(k >= 0 && k < values.length)) return;
      const truth = shown.find((other) => other.reference), own = values[k];
      const words = isFinite(own) ? `${own.toFixed(2)} K (${(own - 273.15).toFixed(2)} °C)` : "no temperature";
      const error = truth && !each.reference ? `, error ${(own - truth.picture.values[k]).toFixed(2)} K` : "";
      kelvin.textContent = `${each.label}: ${words}${error}`;
    });
  }
  draw();
}

if (views.length) {
  chooser.addEventListener("change", show);
  mode.addEventListener("change", draw);
  show();
}
