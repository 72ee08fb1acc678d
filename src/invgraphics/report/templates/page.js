"use strict";
(() => {
  // Sliders: the range input holds the value and takes the keyboard; pointers drag anywhere on the picture.
  // All sliders of one view move together, so that every method shows the same part of the picture.
  const setCut = (view, percent) => {
    const value = Math.min(100, Math.max(0, percent));
    for (const slider of view.querySelectorAll(".slider")) {
      slider.style.setProperty("--cut", value + "%");
      slider.querySelector("input").value = value;
    }
  };
  for (const input of document.querySelectorAll(".slider input")) {
    input.addEventListener("input", () => setCut(input.closest(".view"), Number(input.value)));
  }

  // Zoom: all pictures of a view show the same part. x and y place the picture's corner, in percent of its frame.
  const MOST = 32;
  const state = new WeakMap();
  const zoomOf = (view) => state.get(view) ?? { zoom: 1, x: 0, y: 0 };
  const setZoom = (view, zoom, x, y) => {
    const edge = 100 * (1 - zoom);
    const kept = { zoom, x: Math.min(0, Math.max(edge, x)), y: Math.min(0, Math.max(edge, y)) };
    state.set(view, kept);
    view.style.setProperty("--zoom", zoom);
    view.style.setProperty("--tx", kept.x + "%");
    view.style.setProperty("--ty", kept.y + "%");
    view.classList.toggle("zoomed", zoom > 1);
    view.classList.toggle("close", zoom >= 4);
    view.querySelector(".zoom output").textContent = (zoom < 10 ? Math.round(10 * zoom) / 10 : Math.round(zoom)) + "×";
  };
  // The point at (fx, fy) percent of the frame stays where it is.
  const zoomAt = (view, factor, fx, fy) => {
    const { zoom, x, y } = zoomOf(view);
    const next = Math.min(MOST, Math.max(1, zoom * factor));
    setZoom(view, next, fx - ((fx - x) * next) / zoom, fy - ((fy - y) * next) / zoom);
  };
  const place = (frame, event) => {
    const box = frame.getBoundingClientRect();
    return [(100 * (event.clientX - box.left)) / box.width, (100 * (event.clientY - box.top)) / box.height];
  };
  for (const button of document.querySelectorAll(".zoom button")) {
    button.addEventListener("click", () => zoomAt(button.closest(".view"), Number(button.dataset.zoom), 50, 50));
  }

  // Pointers: one drags the line of a slider or, with Shift or on other pictures, a zoomed picture; two pinch.
  for (const frame of document.querySelectorAll(".view .lens, .view .slider")) {
    const view = frame.closest(".view");
    const isSlider = frame.classList.contains("slider");
    const down = new Map();
    let pans = false;
    frame.addEventListener("wheel", (event) => {
      if (!event.ctrlKey && !event.metaKey) return;
      event.preventDefault();
      zoomAt(view, Math.exp(-0.01 * Math.max(-60, Math.min(60, event.deltaY))), ...place(frame, event));
    }, { passive: false });
    frame.addEventListener("dblclick", (event) => {
      event.preventDefault();
      if (zoomOf(view).zoom > 1) setZoom(view, 1, 0, 0);
      else zoomAt(view, 4, ...place(frame, event));
    });
    frame.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      pans = !isSlider || event.shiftKey;
      down.set(event.pointerId, place(frame, event));
      const used = !pans || zoomOf(view).zoom > 1 || down.size > 1;
      if (!used) return;
      event.preventDefault();
      frame.setPointerCapture(event.pointerId);
      if (!pans && down.size === 1) {
        frame.querySelector("input").focus({ preventScroll: true });
        setCut(view, place(frame, event)[0]);
      }
    });
    frame.addEventListener("pointermove", (event) => {
      const before = down.get(event.pointerId);
      if (!before) return;
      if (!event.buttons) return down.delete(event.pointerId); // released where the frame did not see it
      const now = place(frame, event);
      down.set(event.pointerId, now);
      if (down.size === 2) {
        const other = [...down].find(([id]) => id !== event.pointerId)[1];
        const span = (point) => Math.hypot(point[0] - other[0], point[1] - other[1]);
        if (span(before) > 0) zoomAt(view, span(now) / span(before), (now[0] + other[0]) / 2, (now[1] + other[1]) / 2);
      } else if (pans) {
        const { zoom, x, y } = zoomOf(view);
        if (zoom > 1) setZoom(view, zoom, x + now[0] - before[0], y + now[1] - before[1]);
      } else setCut(view, now[0]);
    });
    for (const end of ["pointerup", "pointercancel", "lostpointercapture"]) {
      frame.addEventListener(end, (event) => down.delete(event.pointerId));
    }
  }

  for (const select of document.querySelectorAll("select.left")) {
    select.addEventListener("change", () => {
      for (const over of select.closest(".view").querySelectorAll(".over")) over.src = select.value;
    });
  }

  // Views: one at a time in each gallery, chosen by its strip of thumbnails or by the address.
  const choose = (gallery, id) => {
    for (const view of gallery.querySelectorAll(".view")) view.hidden = view.id !== id;
    for (const link of gallery.querySelectorAll("nav.views a")) {
      if (link.hash === "#" + id) link.setAttribute("aria-current", "true");
      else link.removeAttribute("aria-current");
    }
  };
  for (const gallery of document.querySelectorAll(".gallery")) {
    const first = gallery.querySelector(".view");
    if (first) choose(gallery, first.id);
    for (const link of gallery.querySelectorAll("nav.views a")) {
      link.addEventListener("click", (event) => {
        event.preventDefault();
        choose(gallery, link.hash.slice(1));
      });
    }
  }
  // An address inside something folded opens it; an address of a view chooses it.
  const arrive = () => {
    let name = location.hash.slice(1);
    try { name = decodeURIComponent(name); } catch { /* no encoded address: taken as it stands */ }
    const target = document.getElementById(name);
    if (!target) return;
    for (let fold = target.closest("details"); fold; fold = fold.parentElement.closest("details")) fold.open = true;
    const own = target.querySelector(":scope > details");
    if (own) own.open = true;
    const gallery = target.matches(".view") && target.closest(".gallery");
    if (gallery) choose(gallery, target.id);
    target.scrollIntoView();
  };
  if (location.hash) arrive();
  addEventListener("hashchange", arrive);

  // Copy buttons, with a way for browsers that keep the clipboard from pages on disk.
  const copy = async (text) => {
    try {
      await navigator.clipboard.writeText(text);
      return true;
    } catch {
      const area = Object.assign(document.createElement("textarea"), { value: text });
      document.body.append(area);
      area.select();
      const done = document.execCommand("copy");
      area.remove();
      return done;
    }
  };
  for (const button of document.querySelectorAll("button.copy")) {
    button.addEventListener("click", async () => {
      const done = await copy(button.parentElement.querySelector("code").textContent);
      button.textContent = done ? "Copied" : "Select it";
      setTimeout(() => (button.textContent = button.dataset.label), 1500);
    });
  }

  // Tables that sort: a head orders the rows by its column, best first and then the other way; rows without a value come last.
  for (const head of document.querySelectorAll("table.sortable th[data-better]")) {
    const button = Object.assign(document.createElement("button"), { type: "button", className: "sort" });
    button.append(...head.childNodes);
    head.append(button);
    button.addEventListener("click", () => {
      const best = head.dataset.better === "higher" ? "descending" : "ascending";
      const other = best === "descending" ? "ascending" : "descending";
      const order = head.ariaSort === best ? other : best;
      for (const one of head.parentElement.children) one.removeAttribute("aria-sort");
      head.setAttribute("aria-sort", order);
      const sign = order === "descending" ? -1 : 1;
      const value = (row) => row.cells[head.cellIndex].dataset.value;
      const body = head.closest("table").tBodies[0];
      const rows = [...body.rows].sort((one, two) => {
        const [a, b] = [value(one), value(two)];
        if (a === undefined || b === undefined) return (a === undefined) - (b === undefined);
        return sign * (a - b);
      });
      body.append(...rows);
    });
  }

  // On paper everything is open, and every picture is there.
  const folded = new Set();
  addEventListener("beforeprint", () => {
    for (const image of document.images) image.loading = "eager";
    for (const details of document.querySelectorAll("details:not([open])")) folded.add(details);
    for (const details of folded) details.open = true;
  });
  addEventListener("afterprint", () => {
    for (const details of folded) details.open = false;
    folded.clear();
  });
})();
