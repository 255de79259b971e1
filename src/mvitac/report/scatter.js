// The explorer's map: a canvas of points to pan, zoom, hover and click, or to walk through by keyboard. `props.value` is
// the JSON of ExplorerData.points. 100,000 points are drawn as small squares in one pass per colour, gray ones first.
// The nearest to the pointer is found by a linear search.
const canvas = element.querySelector("canvas"), tip = element.querySelector(".tip");
const legend = element.querySelector(".legend");
const count = element.querySelector(".count"), context = canvas.getContext("2d");
const left = 30, right = 12, top = 12, bottom = 30;  // margins around the points, in CSS pixels
let data = { x: [], y: [], group: [], row: [], legend: [] }, view = { x: 0, y: 0, zoom: 1 }, hovered = -1, drag = null;
let slots = [], ages = [], clock = 0;  // name and time of choice of the group in each colour

function load() {
  const given = JSON.parse(props.value || "{}");
  if (given.row === undefined) return;
  if (given.by !== data.by) {  // another colouring; a filter keeps what was chosen
    slots = given.hues.map((_, k) => given.coloured[k] ?? null);
    ages = slots.map(() => clock++);
  }
  data = given;
  if (given.bar) legend.replaceChildren(bar(given));
  else legend.replaceChildren(...given.legend.map((name) => {
    const item = document.createElement("button");
    item.type = "button";
    item.append(document.createElement("i"), name);
    item.addEventListener("click", () => choose(name));
    return item;
  }));
  element.dataset.points = data.row.length;
  hide();
  paint();
}

function bar(given) {  // the colours from the lowest to the highest value, instead of a button for each group
  const [low, high, target] = given.bar, box = document.createElement("div"), strip = document.createElement("i");
  box.className = "bar";
  strip.style.background = `linear-gradient(to right, ${given.hues.join(", ")})`;
  box.append(`${target}: ${low}`, strip, high);
  return box;
}

function choose(name) {  // in colour or in gray; if all colours are taken, in that of the group chosen first
  let k = slots.indexOf(name);
  if (k >= 0) slots[k] = null;
  else {
    k = slots.findIndex((taken) => !data.legend.includes(taken));
    if (k < 0) k = ages.indexOf(Math.min(...ages));
    slots[k] = name;
    ages[k] = clock++;
  }
  draw();
  paint();
}

function paint() {  // the legend
  if (data.bar) {
    count.textContent = data.row.length ? `${data.row.length} pairs; gray: not measured`
      : "nothing to show: choose another split or filter";
    return;
  }
  const shown = data.legend.filter((name) => slots.includes(name)).length;
  data.legend.forEach((name, g) => {
    const item = legend.children[g], k = slots.indexOf(name);
    item.setAttribute("aria-pressed", k >= 0);
    item.firstChild.style.background = k >= 0 ? data.hues[k] : data.gray;
  });
  count.textContent = !data.row.length ? "nothing to show: choose another split or filter"
    : `${data.row.length} pairs; ${shown} of ${data.legend.length} in colour, at most ${slots.length}`;
}

function place(i) {  // canvas position of point i, in CSS pixels
  return [left + wide() * (0.5 + (data.x[i] - 0.5 + view.x) * view.zoom),
          top + high() * (0.5 + (data.y[i] - 0.5 + view.y) * view.zoom)];
}

function wide() { return Math.max(1, canvas.clientWidth - left - right); }

function high() { return Math.max(1, canvas.clientHeight - top - bottom); }

function inside(x, y) {
  return x >= 0.7 * left && y >= 0 && x <= canvas.clientWidth && y <= canvas.clientHeight - 0.7 * bottom;
}

function draw() {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = canvas.clientWidth * ratio; canvas.height = canvas.clientHeight * ratio;
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  const size = data.row.length > 20000 ? 2 : data.row.length > 3000 ? 4 : 6;
  const slot = data.legend.map((name) => slots.indexOf(name));
  for (let k = -1; k < slots.length; k++) {
    context.fillStyle = k < 0 ? data.gray : data.hues[k];
    for (let i = 0; i < data.row.length; i++) {
      if (slot[data.group[i]] !== k) continue;
      const [x, y] = place(i);
      if (inside(x, y)) context.fillRect(x - size / 2, y - size / 2, size, size);
    }
  }
  context.strokeStyle = context.fillStyle = getComputedStyle(canvas).color;
  if (hovered >= 0) {
    const [x, y] = place(hovered);
    context.lineWidth = 2;
    context.strokeRect(x - size, y - size, 2 * size, 2 * size);
  }
  if (data.axes) title(data.axes);
}

function title([across, down]) {  // what the axes are, as far as there is room
  context.font = "12px system-ui, sans-serif";
  context.textAlign = "center";
  const short = (text) => text.replace("principal component", "PC").replace("of the variance", "of variance");
  const fit = (text, room) => context.measureText(text).width <= room - 20 ? text : short(text);
  context.fillText(fit(across, wide()) + " \u2192", left + wide() / 2, canvas.clientHeight - 9);
  context.save();
  context.translate(16, top + high() / 2);
  context.rotate(-Math.PI / 2);
  context.fillText("\u2190 " + fit(down, high()), 0, 0);
  context.restore();
}

function zoom(factor, event) {  // the point under the pointer stays there
  const box = canvas.getBoundingClientRect(), before = view.zoom;
  const px = (event.clientX - box.left - left) / wide() - 0.5, py = (event.clientY - box.top - top) / high() - 0.5;
  view.zoom = Math.max(0.5, Math.min(200, view.zoom * factor));
  view.x += px / view.zoom - px / before; view.y += py / view.zoom - py / before;
  hide();
}

function hide() { hovered = -1; tip.style.display = "none"; draw(); }

function nearest(event) {
  const box = canvas.getBoundingClientRect(), px = event.clientX - box.left, py = event.clientY - box.top;
  let best = -1, least = 15 * 15;
  for (let i = 0; i < data.row.length; i++) {
    const [x, y] = place(i), d = (x - px) ** 2 + (y - py) ** 2;
    if (d < least) { least = d; best = i; }
  }
  return best;
}

function show(event) { return reveal(nearest(event)); }

async function reveal(now) {
  if (now === hovered) return;
  hovered = now;
  draw();
  if (now < 0) { tip.style.display = "none"; return; }
  const row = data.row[now], html = await server.tip(row);
  if (hovered !== now) return;  // the pointer has moved on
  tip.innerHTML = html;
  tip.style.display = "block";
  const [x, y] = place(now);
  tip.style.left = `${Math.max(0, Math.min(x + 12, canvas.clientWidth - tip.offsetWidth))}px`;
  tip.style.top = `${y > canvas.clientHeight / 2 ? y - tip.offsetHeight - 12 : y + 12}px`;
}

function beside(dx, dy) {  // the point next to the current one in a direction, or the one nearest to the middle
  const here = hovered >= 0 ? place(hovered) : [left + wide() / 2, top + high() / 2];
  let best = hovered, least = Infinity;
  for (let i = 0; i < data.row.length; i++) {
    const [x, y] = place(i), along = (x - here[0]) * dx + (y - here[1]) * dy;
    const aside = Math.abs((x - here[0]) * dy) + Math.abs((y - here[1]) * dx);
    if (i === hovered || !inside(x, y) || (hovered >= 0 && (along <= 0 || aside > along))) continue;
    const distance = hovered >= 0 ? along + 2 * aside : Math.hypot(x - here[0], y - here[1]);
    if (distance < least) { least = distance; best = i; }
  }
  return best;
}

canvas.addEventListener("keydown", (e) => {
  const arrow = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] }[e.key];
  const factor = { "+": 1.5, "=": 1.5, "-": 1 / 1.5 }[e.key], kept = hovered;
  if (arrow) reveal(beside(...arrow));
  else if (factor) {
    const box = canvas.getBoundingClientRect();
    const [x, y] = kept >= 0 ? place(kept) : [left + wide() / 2, top + high() / 2];
    zoom(factor, { clientX: box.left + x, clientY: box.top + y });
    reveal(kept);
  } else if (e.key === "0") reset();
  else if (e.key === "Escape") hide();
  else if ((e.key === "Enter" || e.key === " ") && kept >= 0) trigger("click", { row: data.row[kept] });
  else return;
  e.preventDefault();
});

// Active pointers. The mouse or one finger drags; two fingers also zoom about the point between them.
const fingers = new Map();
function grip() {
  const all = [...fingers.values()], mean = (key) => all.reduce((sum, f) => sum + f[key], 0) / all.length;
  const spread = all.length > 1 ? Math.hypot(all[0].clientX - all[1].clientX, all[0].clientY - all[1].clientY) : 0;
  return { clientX: mean("clientX"), clientY: mean("clientY"), spread };
}

canvas.addEventListener("pointerdown", (e) => {
  fingers.set(e.pointerId, { clientX: e.clientX, clientY: e.clientY });
  drag = { at: grip(), moved: fingers.size > 1 };
  canvas.setPointerCapture(e.pointerId);
});
canvas.addEventListener("pointermove", (e) => {
  if (!fingers.has(e.pointerId)) return show(e);
  fingers.set(e.pointerId, { clientX: e.clientX, clientY: e.clientY });
  const now = grip(), dx = now.clientX - drag.at.clientX, dy = now.clientY - drag.at.clientY;
  if (drag.moved || Math.abs(dx) + Math.abs(dy) > 4) {
    drag.moved = true;
    view.x += dx / wide() / view.zoom; view.y += dy / high() / view.zoom;
    zoom(now.spread && drag.at.spread ? now.spread / drag.at.spread : 1, now);
    drag.at = now;
  }
});
canvas.addEventListener("pointercancel", () => { fingers.clear(); drag = null; });
canvas.addEventListener("pointerup", (e) => {
  fingers.delete(e.pointerId);
  if (fingers.size) { drag = { at: grip(), moved: true }; return; }
  const clicked = drag && !drag.moved ? nearest(e) : -1;
  drag = null;
  if (clicked >= 0) { show(e); trigger("click", { row: data.row[clicked] }); }
});
canvas.addEventListener("pointerleave", () => { if (!drag) hide(); });
canvas.addEventListener("blur", hide);
canvas.addEventListener("wheel", (e) => {
  e.preventDefault();
  zoom(Math.exp(-e.deltaY / 400), e);
}, { passive: false });
function reset() { view = { x: 0, y: 0, zoom: 1 }; hide(); }
canvas.addEventListener("dblclick", reset);
new ResizeObserver(hide).observe(canvas);
watch("value", load);
load();
