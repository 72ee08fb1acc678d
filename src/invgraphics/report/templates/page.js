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
  for (const slider of document.querySelectorAll(".slider")) {
    const view = slider.closest(".view");
    const input = slider.querySelector("input");
    input.addEventListener("input", () => setCut(view, Number(input.value)));
    const follow = (event) => {
      const box = slider.getBoundingClientRect();
      setCut(view, (100 * (event.clientX - box.left)) / box.width);
    };
    slider.addEventListener("pointerdown", (event) => {
      if (event.button !== 0) return;
      event.preventDefault();
      slider.setPointerCapture(event.pointerId);
      input.focus({ preventScroll: true });
      follow(event);
    });
    slider.addEventListener("pointermove", (event) => {
      if (slider.hasPointerCapture(event.pointerId)) follow(event);
    });
  }

  for (const select of document.querySelectorAll("select.left")) {
    select.addEventListener("change", () => {
      for (const over of select.closest(".view").querySelectorAll(".over")) over.src = select.value;
    });
  }

  // Views: one at a time, chosen by the strip of thumbnails or by the address.
  const views = [...document.querySelectorAll(".view")];
  const choose = (id) => {
    for (const view of views) view.hidden = view.id !== id;
    for (const link of document.querySelectorAll("nav.views a")) {
      if (link.hash === "#" + id) link.setAttribute("aria-current", "true");
      else link.removeAttribute("aria-current");
    }
  };
  const named = () => views.find((view) => "#" + view.id === location.hash);
  if (views.length) choose((named() ?? views[0]).id);
  addEventListener("hashchange", () => {
    const view = named();
    if (view) {
      choose(view.id);
      view.scrollIntoView();
    }
  });
  for (const link of document.querySelectorAll("nav.views a")) {
    link.addEventListener("click", (event) => {
      event.preventDefault();
      choose(link.hash.slice(1));
    });
  }

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

  // On paper everything is open.
  addEventListener("beforeprint", () => {
    for (const details of document.querySelectorAll("details")) details.open = true;
  });
})();
