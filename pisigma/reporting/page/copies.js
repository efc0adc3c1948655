// Buttons to copy and download every figure and every element of class "data", which has a table. Every page has this script.
"use strict";
(() => {
  const quoted = (text) => (/[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text);
  const shown = (cell) => cell.querySelector("input")?.value ?? cell.innerText.trim().replaceAll("−", "-");
  const lines = (table, join) => [...table.rows].filter((row) => !row.hidden).map((row) => join([...row.cells].map(shown)));
  const csv = (box) => {  // the data of a figure, else the table
    const data = box.querySelector("template"), line = (cells) => cells.map(quoted).join(",");
    if (data) return data.content.textContent.trimStart();
    return (box.csv ? box.csv().map(line) : lines(box.querySelector("table"), line)).join("\n") + "\n";
  };
  const save = (name, blob) => {
    const link = Object.assign(document.createElement("a"), { href: URL.createObjectURL(blob), download: name });
    link.click();
    setTimeout(() => URL.revokeObjectURL(link.href), 1000);
  };
  const styled = (svg) => {  // a chart of the page's style sheet with its present colours
    const copy = svg.cloneNode(true), originals = svg.querySelectorAll("*"), box = svg.viewBox.baseVal;
    copy.querySelectorAll("*").forEach((one, number) => {
      for (const name of ["fill", "stroke", "stroke-width", "stroke-dasharray", "font-size", "font-family"])
        one.style.setProperty(name, getComputedStyle(originals[number]).getPropertyValue(name));
    });
    copy.setAttribute("width", box.width); copy.setAttribute("height", box.height);
    return "data:image/svg+xml;charset=utf-8," + encodeURIComponent(new XMLSerializer().serializeToString(copy));
  };
  const png = async (box) => {  // drawings of files are dark on white in every scheme, as documents need them
    const drawn = box.querySelector("canvas, svg, img"), isCanvas = drawn.tagName === "CANVAS";
    let picture = drawn;
    if (!isCanvas) { picture = new Image(); picture.src = drawn.tagName === "IMG" ? drawn.src : styled(drawn); await picture.decode(); }
    const scale = isCanvas ? 1 : 2, canvas = document.createElement("canvas");
    canvas.width = scale * picture.width; canvas.height = scale * picture.height;
    const pen = canvas.getContext("2d");
    pen.fillStyle = drawn.tagName === "IMG" ? "#ffffff" : getComputedStyle(document.body).backgroundColor;
    pen.fillRect(0, 0, canvas.width, canvas.height);
    pen.drawImage(picture, 0, 0, canvas.width, canvas.height);
    return new Promise((done) => canvas.toBlob(done, "image/png"));
  };
  const copy = async (box) => {
    if (box.querySelector("canvas, svg, img")) return navigator.clipboard.write([new ClipboardItem({ "image/png": png(box) })]);
    const code = box.matches(".command") ? box.querySelector("code").textContent : null;
    return navigator.clipboard.writeText(code ?? lines(box.querySelector("table"), (cells) => cells.join("\t")).join("\n"));
  };
  const answer = (button, text) => {
    button.dataset.label ??= button.textContent;
    button.textContent = text;
    setTimeout(() => { button.textContent = button.dataset.label; }, 1500);
  };
  document.addEventListener("click", async (event) => {
    const button = event.target.closest("button[data-copy], button[data-csv], button[data-png]");
    if (!button) return;
    const box = button.closest(".command, figure, .data"), name = (box.dataset.name || "table").replaceAll(/[^\p{L}\p{N}.-]+/gu, "_");
    try {
      if (button.dataset.csv !== undefined) save(`${name}.csv`, new Blob([csv(box)], { type: "text/csv" }));
      else if (button.dataset.png !== undefined) save(`${name}.png`, await png(box));
      else { await copy(box); answer(button, "Copied"); }
    } catch { answer(button, "Not possible here"); }
  });
  const equip = () => {
    for (const box of document.querySelectorAll("figure, .data")) {
      if (box.querySelector(".copies")) continue;
      const kinds = box.querySelector("canvas, svg, img") ? ["Copy", "CSV", "PNG"] : ["Copy", "CSV"];
      const bar = Object.assign(document.createElement("span"), { className: "copies" });
      bar.append(...kinds.map((kind) => {
        const button = Object.assign(document.createElement("button"), { type: "button", textContent: kind });
        button.dataset[kind.toLowerCase()] = "";
        button.setAttribute("aria-label", `${kind}: ${box.dataset.name || "table"}`);
        return button;
      }));
      (box.querySelector("figcaption") ?? box).append(" ", bar);
    }
  };
  equip();
  new MutationObserver(equip).observe(document.body, { childList: true, subtree: true });
  addEventListener("beforeprint", () => document.querySelectorAll("details").forEach((one) => { one.open = true; }));
})();
