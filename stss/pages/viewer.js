// SPDX-License-Identifier: MIT
// The viewer: pictures of one frame beside, above or against each other. Its data stand in the page as JSON.
"use strict";
{
  const data = JSON.parse(document.getElementById("data").textContent);
  const of = (id) => document.getElementById(id);
  const stage = of("stage"), left = of("left"), right = of("right"), zoom = of("zoom"), gain = of("gain"), rate = of("rate");
  const make = (tag, properties = {}, ...children) => {
    const made = Object.assign(document.createElement(tag), properties);
    made.append(...children);
    return made;
  };
  const calm = matchMedia("(prefers-reduced-motion: reduce)").matches;
  const state = { at: 0, mode: "slider", x: 0.5, y: 0.5, running: !calm };

  const frame = () => data.frames[state.at];
  const url = (view) => data.pictures[frame().pictures[view]];
  const has = (view) => view in frame().pictures;
  const picture = (view) => make("img", { src: url(view), alt: `${view}, ${frame().name}`, draggable: false });
  const panel = (side, ...views) => {
    const text = side === "difference" ? `difference of ${views.join(" and ")}` : views.at(-1); // of two, the last one is on top
    const tag = make("span", { className: "tag", textContent: text });
    tag.setAttribute("aria-hidden", "true");
    return make("div", { className: `frame ${side}` }, ...views.map(picture), tag);
  };

  const show = {
    slider(a, b) {
      const compare = make("image-compare"), first = panel("left", a), second = panel("right", b);
      compare.setAttribute("label-text", `How much of ${a} is shown, in percent; ${b} takes the rest`);
      first.slot = "image-1";
      second.slot = "image-2";
      compare.append(first, second);
      const before = stage.querySelector("image-compare");
      stage.replaceChildren(compare);
      if (before) { // the divider stays where it was
        const range = compare.shadowRoot.querySelector("input");
        range.value = before.shadowRoot.querySelector("input").value;
        compare.style.setProperty("--exposure", `${range.value}%`);
      }
    },
    flicker(a, b) {
      const both = panel("flicker", a, b);
      stage.replaceChildren(both);
      let count = 0;
      const step = () => {
        if (!both.isConnected) return;
        const second = both.querySelectorAll("img")[1];
        if (state.running && ++count % Number(rate.value) === 0) {
          const hidden = second.style.visibility !== "hidden";
          second.style.visibility = hidden ? "hidden" : "visible";
          both.querySelector(".tag").textContent = hidden ? a : b;
          both.dataset.turns = String(Number(both.dataset.turns ?? 0) + 1);
        }
        requestAnimationFrame(step);
      };
      requestAnimationFrame(step);
    },
    difference(a, b) {
      stage.replaceChildren(panel("difference", a, b));
    },
    panels() {
      stage.replaceChildren(...data.views.filter(has).map((view) => panel("", view)));
    },
  };

  function draw() {
    for (const select of [left, right]) {
      for (const option of select.options) option.disabled = !has(option.value);
      if (!has(select.value)) select.value = data.views.find(has);
    }
    stage.className = state.mode;
    stage.style.setProperty("--aspect", `${frame().size[0]} / ${frame().size[1]}`);
    look();
    show[state.mode](left.value, right.value);
    for (const button of document.querySelectorAll("[data-mode]"))
      button.setAttribute("aria-pressed", String(button.dataset.mode === state.mode));
    for (const [id, modes] of Object.entries({ pair: ["slider", "flicker", "difference"], gaining: ["difference"], turning: ["flicker"] }))
      of(id).hidden = !modes.includes(state.mode);
    of("pause").textContent = state.running ? "pause" : "run";
    of("caption").textContent = frame().caption;
    for (const link of document.querySelectorAll(".strip a")) {
      const here = link.hash === `#frame-${frame().number}`;
      link.setAttribute("aria-current", String(here));
      // Not scrollIntoView, which would move the page too.
      if (here) link.parentElement.scrollLeft = link.offsetLeft - link.parentElement.clientWidth / 2;
    }
    for (const line of document.querySelectorAll("svg .at")) {
      const x = line.ownerSVGElement.querySelector(`[data-frame="${frame().number}"]`)?.dataset.x;
      line.style.display = x === undefined ? "none" : "";
      if (x !== undefined) for (const end of ["x1", "x2"]) line.setAttribute(end, x);
    }
  }

  function look() {
    stage.classList.toggle("zoomed", Number(zoom.value) > 1);
    for (const [name, value] of Object.entries({ "--zoom": zoom.value, "--x": state.x, "--y": state.y, "--gain": gain.value }))
      stage.style.setProperty(name, value);
    of("zoomed").textContent = `${Number(zoom.value).toFixed(zoom.value % 1 ? 1 : 0)}x`;
  }

  const clamp = (value) => Math.min(1, Math.max(0, value));
  function pan(dx, dy) {
    const free = Number(zoom.value) - 1;
    if (free <= 0) return;
    state.x = clamp(state.x - dx / free);
    state.y = clamp(state.y - dy / free);
    look();
  }
  function setZoom(value) {
    zoom.value = String(Math.min(Number(zoom.max), Math.max(1, value)));
    look();
  }
  function setMode(mode) {
    state.mode = mode;
    draw();
  }
  function go(step) {
    const at = Math.min(data.frames.length - 1, Math.max(0, state.at + step));
    if (at === state.at) return;
    location.hash = `frame-${data.frames[at].number}`;
    fromHash(); // the event comes later, perhaps after the next key
  }
  function next(select, step) {
    const views = data.views.filter(has);
    select.value = views[(views.indexOf(select.value) + step + views.length) % views.length];
    draw();
  }
  function swap() {
    [left.value, right.value] = [right.value, left.value];
    draw();
  }
  function pause() {
    state.running = !state.running;
    of("pause").textContent = state.running ? "pause" : "run";
  }
  function fromHash() {
    const number = /^#frame-(\d+)$/.exec(location.hash)?.[1];
    const at = data.frames.findIndex((one) => String(one.number) === number);
    if (at < 0 || at === state.at) return;
    state.at = at;
    draw();
  }

  const keys = {
    ArrowLeft: (shift) => (shift ? pan(0.1, 0) : go(-1)),
    ArrowRight: (shift) => (shift ? pan(-0.1, 0) : go(1)),
    ArrowUp: (shift) => shift && pan(0, 0.1),
    ArrowDown: (shift) => shift && pan(0, -0.1),
    ",": () => go(-1),
    ".": () => go(1),
    s: () => setMode("slider"),
    f: () => setMode("flicker"),
    d: () => setMode("difference"),
    p: () => setMode("panels"),
    a: () => next(left, 1),
    b: () => next(right, 1),
    x: swap,
    "+": () => setZoom(Number(zoom.value) * 2),
    "=": () => setZoom(Number(zoom.value) * 2),
    "-": () => setZoom(Number(zoom.value) / 2),
    0: () => setZoom(1),
    g: () => {
      gain.selectedIndex = (gain.selectedIndex + 1) % gain.length;
      look();
    },
    r: pause,
  };
  document.addEventListener("keydown", (event) => {
    const to = event.composedPath()[0];
    const letter = event.key.length === 1;
    if (event.ctrlKey || event.altKey || event.metaKey || !(event.key in keys)) return;
    // A slider, a list and a button keep the keys that they understand themselves; a list understands letters too.
    if (to.matches?.("select") || (!letter && !event.shiftKey && to.matches?.("input, button, a, summary, .scroll"))) return;
    if (!event.shiftKey && /^Arrow(Up|Down)$/.test(event.key)) return;
    keys[event.key](event.shiftKey);
    event.preventDefault();
  });

  let held = null;
  stage.addEventListener("pointerdown", (event) => {
    // The slider takes plain drags; with shift, or in the other views, a drag moves the picture.
    if (Number(zoom.value) <= 1 || (state.mode === "slider" && !event.shiftKey) || event.button !== 0) return;
    held = [event.clientX, event.clientY];
    stage.setPointerCapture(event.pointerId);
    event.preventDefault();
    event.stopPropagation();
  }, true);
  stage.addEventListener("pointermove", (event) => {
    if (!held) return;
    const box = stage.querySelector(".frame").getBoundingClientRect();
    pan((event.clientX - held[0]) / box.width, (event.clientY - held[1]) / box.height);
    held = [event.clientX, event.clientY];
  });
  for (const name of ["pointerup", "pointercancel"]) stage.addEventListener(name, () => (held = null));
  stage.addEventListener("wheel", (event) => {
    if (!event.ctrlKey) return; // a plain wheel scrolls the page
    event.preventDefault();
    setZoom(Number(zoom.value) * (event.deltaY < 0 ? 1.25 : 0.8));
  }, { passive: false });

  for (const button of document.querySelectorAll("[data-mode]")) button.addEventListener("click", () => setMode(button.dataset.mode));
  for (const select of [left, right]) select.addEventListener("change", draw);
  for (const control of [zoom, gain]) control.addEventListener("input", look);
  of("swap").addEventListener("click", swap);
  of("pause").addEventListener("click", pause);
  addEventListener("hashchange", fromHash);

  left.value = data.left;
  right.value = data.right;
  draw();
  fromHash();
}
