"use strict";
// Chips: the radio button of a group shows the figure that it names.
for (const group of document.querySelectorAll("fieldset.chips")) {
  const choose = () => {
    for (const button of group.querySelectorAll("input")) {
      document.getElementById(button.value).hidden = !button.checked;
    }
  };
  group.addEventListener("change", choose);
  choose();
}

// Before and after: one position for all views, by the pointer or by the range below.
const range = document.getElementById("cut");
if (range) {
  const views = [...document.querySelectorAll(".compare")];
  const move = (share) => {
    range.value = share;
    range.setAttribute("aria-valuetext", Math.round(share) + " % from the left: photo, then result");
    for (const view of views) {
      view.querySelector(".after").style.clipPath = "inset(0 0 0 " + share + "%)";
      view.querySelector(".line").style.left = share + "%";
    }
  };
  range.addEventListener("input", () => move(Number(range.value)));
  move(Number(range.value));
  for (const view of views) {
    const follow = (event) => {
      if (view.classList.contains("exact")) {
        view.scrollLeft -= event.movementX;
        view.scrollTop -= event.movementY;
        return;
      }
      const box = view.getBoundingClientRect();
      move(Math.min(100, Math.max(0, (100 * (event.clientX - box.left)) / box.width)));
    };
    view.addEventListener("pointerdown", (event) => {
      const isExact = view.classList.contains("exact");
      if (isExact && (event.pointerType === "touch" || event.target === view)) return;
      event.preventDefault();
      view.setPointerCapture(event.pointerId);
      follow(event);
    });
    view.addEventListener("pointermove", (event) => {
      if (view.hasPointerCapture(event.pointerId)) follow(event);
    });
  }
  // 1:1: a pixel of the picture on a pixel of the screen, the object in the middle at first.
  const button = document.getElementById("exact");
  button.addEventListener("click", () => {
    const isExact = button.getAttribute("aria-pressed") !== "true";
    button.setAttribute("aria-pressed", String(isExact));
    for (const view of views) {
      const stage = view.querySelector(".stage");
      const width = Number(view.querySelector("img").getAttribute("width"));
      view.classList.toggle("exact", isExact);
      stage.style.width = isExact ? width / window.devicePixelRatio + "px" : "";
      const { hidden } = view;
      view.hidden = false; // what is not laid out cannot be scrolled
      view.scrollLeft = Number(view.dataset.x || 0.5) * stage.clientWidth - view.clientWidth / 2;
      view.scrollTop = Number(view.dataset.y || 0.5) * stage.clientHeight - view.clientHeight / 2;
      view.hidden = hidden;
    }
  });
}

// Panoramas: the values themselves (RGBE), shown at another exposure with the picture's operator.
async function unpack(text) {
  const packed = Uint8Array.from(atob(text), (c) => c.charCodeAt(0));
  const stream = new Blob([packed]).stream().pipeThrough(new DecompressionStream("deflate"));
  return new Uint8Array(await new Response(stream).arrayBuffer());
}
for (const sky of document.querySelectorAll(".sky[data-rgbe]")) {
  const canvas = sky.querySelector("canvas");
  const slider = document.getElementById(sky.dataset.slider);
  const shown = slider.parentElement.querySelector("output");
  let codes = null;
  const draw = async () => {
    const stops = Number(slider.value);
    shown.textContent = (stops > 0 ? "+" : "") + stops + " EV";
    codes = codes || (await unpack(sky.dataset.rgbe));
    const image = new ImageData(canvas.width, canvas.height);
    const gain = 2 ** stops;
    for (let k = 0; k < codes.length; k += 4) {
      const unit = gain * 2 ** (codes[k + 3] - 136);
      for (let c = 0; c < 3; c++) {
        const value = codes[k + c] * unit;
        const tone = sky.dataset.tone === "reinhard" ? value / (1 + value) : Math.min(value, 1);
        image.data[k + c] = Math.round(255 * tone ** (1 / 2.2));
      }
      image.data[k + 3] = 255;
    }
    canvas.getContext("2d").putImageData(image, 0, 0);
    canvas.hidden = false;
  };
  slider.addEventListener("input", draw);
}
