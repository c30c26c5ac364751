// Zoom and pan: buttons, Ctrl + wheel, drag. Without it every figure is complete.
document.documentElement.classList.add("scripted");
let figures = 0;
for (const sheet of document.querySelectorAll(".sheet")) {
  const svg = sheet.querySelector("svg.plot");
  const whole = svg.viewBox.baseVal;
  const home = { x: whole.x, y: whole.y, w: whole.width, h: whole.height };
  let view = { ...home };
  const show = () => {
    view.x = Math.min(Math.max(view.x, home.x), home.x + home.w - view.w);
    view.y = Math.min(Math.max(view.y, home.y), home.y + home.h - view.h);
    svg.setAttribute("viewBox", [view.x, view.y, view.w, view.h].join(" "));
    sheet.classList.toggle("zoomed", view.w < home.w);
  };
  const zoom = (factor, u, v) => {
    const w = Math.min(home.w, Math.max(home.w / 64, view.w / factor));
    const h = (w * home.h) / home.w;
    view = { x: view.x + u * (view.w - w), y: view.y + v * (view.h - h), w, h };
    show();
  };
  const place = (event) => {
    const box = svg.getBoundingClientRect();
    return [(event.clientX - box.left) / box.width, (event.clientY - box.top) / box.height];
  };
  svg.addEventListener("wheel", (event) => {
    if (!event.ctrlKey && !event.metaKey) return;
    event.preventDefault();
    zoom(Math.exp(-event.deltaY / 300), ...place(event));
  }, { passive: false });
  let held = null;
  svg.addEventListener("pointerdown", (event) => {
    if (view.w >= home.w) return;
    held = place(event);
    svg.setPointerCapture(event.pointerId);
  });
  svg.addEventListener("pointermove", (event) => {
    if (!held) return;
    const now = place(event);
    view.x -= (now[0] - held[0]) * view.w;
    view.y -= (now[1] - held[1]) * view.h;
    held = now;
    show();
  });
  svg.addEventListener("pointerup", () => { held = null; });
  svg.addEventListener("pointercancel", () => { held = null; });
  const actions = { "+": () => zoom(1.6, 0.5, 0.5), "\u2212": () => zoom(1 / 1.6, 0.5, 0.5), "\u21ba": () => { view = { ...home }; show(); } };
  const names = { "+": "Zoom in", "\u2212": "Zoom out", "\u21ba": "Show all" };
  const tools = document.createElement("div");
  tools.className = "tools";
  for (const [sign, action] of Object.entries(actions)) {
    const button = document.createElement("button");
    button.type = "button";
    button.textContent = sign;
    button.title = names[sign];
    button.setAttribute("aria-label", names[sign]);
    button.addEventListener("click", action);
    tools.append(button);
  }
  sheet.closest("figure").prepend(tools);
  figures += 1;
}
// How far this came, for those who look from outside.
document.documentElement.dataset.figures = figures;
