// The explorer's map: a canvas of points to pan, zoom, hover and click. `props.value` is the JSON of ExplorerData.points.
// 100,000 points are drawn as small squares in one pass. The nearest to the pointer is found by a linear search.
const canvas = element.querySelector("canvas"), tip = element.querySelector(".tip"), legend = element.querySelector(".legend");
const count = element.querySelector(".count"), context = canvas.getContext("2d");
let data = { x: [], y: [], colour: [], row: [], legend: [] }, view = { x: 0, y: 0, zoom: 1 }, hovered = -1, drag = null;

function bytes(text) { return Uint8Array.from(atob(text), (c) => c.charCodeAt(0)); }

function load() {
  const given = JSON.parse(props.value || "{}");
  if (given.row === undefined) return;
  const xy = new Uint16Array(bytes(given.xy).buffer);
  data = { x: xy.subarray(0, xy.length / 2), y: xy.subarray(xy.length / 2),
           colour: new Uint16Array(bytes(given.colour).buffer), row: new Int32Array(bytes(given.row).buffer), legend: given.legend };
  legend.replaceChildren(...given.legend.map(([name, colour]) => {
    const item = document.createElement("span"), dot = document.createElement("i");
    dot.style.background = colour;
    item.append(dot, name);
    return item;
  }));
  count.textContent = data.row.length ? `${data.row.length} pairs` : "nothing to show: choose another split or filter";
  element.dataset.points = data.row.length;
  hovered = -1;
  draw();
}

function place(i) {  // canvas position of point i, in CSS pixels
  return [canvas.clientWidth / 2 + (data.x[i] / 65535 - 0.5 + view.x) * side(),
          canvas.clientHeight / 2 + (data.y[i] / 65535 - 0.5 + view.y) * side()];
}

function draw() {
  const ratio = window.devicePixelRatio || 1;
  canvas.width = canvas.clientWidth * ratio; canvas.height = canvas.clientHeight * ratio;
  context.setTransform(ratio, 0, 0, ratio, 0, 0);
  const size = data.row.length > 20000 ? 2 : data.row.length > 3000 ? 4 : 6;
  data.legend.forEach(([, colour], c) => {
    context.fillStyle = colour;
    for (let i = 0; i < data.row.length; i++) {
      if (data.colour[i] !== c) continue;
      const [x, y] = place(i);
      context.fillRect(x - size / 2, y - size / 2, size, size);
    }
  });
  if (hovered >= 0) {
    const [x, y] = place(hovered);
    context.strokeStyle = getComputedStyle(canvas).color; context.lineWidth = 2;
    context.strokeRect(x - size, y - size, 2 * size, 2 * size);
  }
}

function side() { return Math.min(canvas.clientWidth, canvas.clientHeight) * 0.92 * view.zoom; }

function zoom(factor, event) {  // the point under the pointer stays there
  const box = canvas.getBoundingClientRect(), before = side();
  const px = event.clientX - box.left - canvas.clientWidth / 2, py = event.clientY - box.top - canvas.clientHeight / 2;
  view.zoom = Math.max(0.5, Math.min(200, view.zoom * factor));
  view.x += px / side() - px / before; view.y += py / side() - py / before;
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

async function show(event) {
  const now = nearest(event);
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
    view.x += dx / side(); view.y += dy / side();
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
canvas.addEventListener("wheel", (e) => {
  e.preventDefault();
  zoom(Math.exp(-e.deltaY / 400), e);
}, { passive: false });
canvas.addEventListener("dblclick", () => { view = { x: 0, y: 0, zoom: 1 }; draw(); });
new ResizeObserver(draw).observe(canvas);
watch("value", load);
load();
