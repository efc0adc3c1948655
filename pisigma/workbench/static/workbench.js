// The page of a cell: tabs, forms that start steps, progress. Everything shown is made by the server; nothing is computed here.
const content = document.getElementById("content"), person = document.getElementById("person");
let tab = location.hash.slice(1), version = -1, running = null;

person.value = localStorage.getItem("person") || "";
person.addEventListener("change", () => localStorage.setItem("person", person.value));
const dark = matchMedia("(prefers-color-scheme: dark)").matches ? "?darkMode" : "";
document.getElementById("scene").src = "scene/" + dark;

async function ask(path, body, type = "application/json") {
  const options = body === undefined ? {} : { method: "POST", headers: { "Content-Type": type }, body };
  const answer = await fetch(path, options);
  if (answer.ok) return answer;
  let said = `the server answered ${answer.status}`, field = "";
  if ((answer.headers.get("Content-Type") || "").includes("json")) ({ error: said, field } = await answer.json());
  else if (answer.status === 413) said = "the file is larger than 200 MB.";
  throw Object.assign(new Error(said), { field });
}

const steps = (path, form) => ask(`${path}?person=${encodeURIComponent(person.value)}`, JSON.stringify(form));

async function show(name, keep = false) {
  const kept = keep ? [...content.querySelectorAll("form")].filter(isEdited).map(form => [form.dataset.step, values(form)]) : [];
  const opened = keep ? [...content.querySelectorAll("details")].map(one => one.open) : [];
  const proposal = keep && content.querySelector("#proposal")?.firstElementChild;
  const top = content.scrollTop;
  content.innerHTML = await (await ask(`tab/${name}`)).text();
  tab = name;
  for (const button of document.querySelectorAll("[role=tab]")) {
    const chosen = button.dataset.tab === name;
    button.setAttribute("aria-selected", chosen);
    button.tabIndex = chosen ? 0 : -1;
  }
  history.replaceState(null, "", "#" + name);
  content.setAttribute("aria-labelledby", "tab-" + name);
  for (const [step, fields] of kept) fill(content.querySelector(`form[data-step="${step}"]`), fields);
  [...content.querySelectorAll("details")].forEach((one, number) => { if (opened[number]) one.open = true; });
  if (proposal && running) content.querySelector("#proposal").append(proposal);
  if (keep) content.scrollTop = top;
  content.querySelectorAll("form").forEach(say);
  lock();
}

// A text is kept while a person changes it, with the digest of the file that it was made from, until it has been saved.
const isEdited = form => form.elements.text?.value !== form.elements.text?.defaultValue || !form.elements.text;

function fill(form, fields) {
  if (!form || form.dataset.fixed !== undefined || (fields.text !== undefined && fields.text === form.elements.text.defaultValue)) return;
  for (const one of form.elements) if (one.name in fields && one.type !== "hidden") {
    if (one.type === "checkbox") one.checked = true; else one.value = fields[one.name];
  }
}

function values(form) {
  const found = {};
  for (const one of form.elements) {
    if (!one.name || one.type === "file" || (one.type === "checkbox" && !one.checked)) continue;
    if (one.value !== "") found[one.name] = one.value;
  }
  return found;
}

const quoted = word => /^[\w@%+=:,.\/-]+$/.test(word) ? word : `'${word.replaceAll("'", `'"'"'`)}'`;

function say(form) {  // the command line that does the same
  const code = form.querySelector(".command code");
  if (!code || !form.dataset.command || form.dataset.fixed !== undefined) return;
  let line = form.dataset.command.trim();
  for (const one of form.elements) {
    const option = one.dataset.option;
    if (one.dataset.word !== undefined && one.value) line += ` ${quoted(one.value)}`;
    else if (!option || one.value === "" || (one.type === "checkbox" && !one.checked)) continue;
    else if (/[=/]$/.test(option)) line += ` ${option}${quoted(one.value)}`;
    else if (one.dataset.kind === "flag") line += one.value === "true" ? ` ${option}` : ` --no-${option.slice(2)}`;
    else if (one.dataset.kind === "switch") line += ` ${option}`;
    else line += ` ${option} ${quoted(one.type === "file" ? one.files[0].name : one.value)}`;
  }
  if (form.elements.export?.value === "") line += " --export none";
  if (form.dataset.rows !== undefined) line += ` --rows ${quoted(`${document.body.dataset.folder}/sessions/${form.elements.session.value}.csv`)}`;
  if (form.dataset.pose !== undefined) line += " --pose " + [...form.querySelectorAll("input")].map(one => one.value || "0").join(" ");
  const stated = [...form.elements].filter(one => one.dataset.key && one.value.trim());
  if (stated.length) line += ` --map ${quoted(stated.map(one => `${one.dataset.key}=${one.value.trim()}`).join(","))}`;
  if (form.dataset.proposal !== undefined) line += ` --cell ${quoted(document.body.dataset.folder)} --yes`;
  const isOne = new Set(stated.map(one => one.dataset.file)).size < 2;
  code.textContent = isOne ? line : "";  // a command has one --map for all files
}

function fault(form, problem) {
  const shown = form.querySelector(".fault");
  shown.textContent = problem ? problem.message : "";
  shown.hidden = !problem;
  const name = problem?.field?.replace(/^--/, "").replaceAll("-", "_").split(".").pop();
  if (name && form.elements[name]?.focus) form.elements[name].focus();
}

async function upload(file) {
  const answer = await ask(`upload?name=${encodeURIComponent(file.name)}`, file, "application/octet-stream");
  return (await answer.json()).file;
}

async function start(form) {
  fault(form, null);
  try {
    const fields = { ...values(form), command: form.querySelector(".command code")?.textContent || "" };
    if (form.dataset.go !== undefined) return show(form.dataset.tabOf);
    for (const one of form.querySelectorAll("[data-upload]")) if (one.files.length) fields[one.dataset.upload] = await upload(one.files[0]);
    await steps(`step/${form.dataset.step}`, fields);
    if (form.dataset.tabOf && form.dataset.tabOf !== tab) await show(form.dataset.tabOf);
    await poll();
  } catch (problem) { fault(form, problem); }
}

async function propose(form) {
  const where = document.getElementById("proposal"), shown = document.getElementById("upload-fault");
  shown.hidden = true;
  try {
    let fields = form ? values(form) : {};
    if (!form) {
      const numbers = [];
      for (const file of document.getElementById("files").files) numbers.push(await upload(file));
      if (!numbers.length) return;
      fields = { files: numbers.join(",") };
    }
    where.innerHTML = await (await ask("propose", JSON.stringify(fields))).text();
    if (form) fill(where.querySelector("form"), fields);
    where.querySelectorAll("form").forEach(say);
    lock();
  } catch (problem) { shown.textContent = problem.message; shown.hidden = false; }
}

function lock() { content.querySelectorAll("form button[type=submit]").forEach(one => { one.disabled = running !== null && one.closest("form").dataset.go === undefined; }); }

let polling = null;
async function poll() {
  clearTimeout(polling);
  try {
    const state = await (await ask("state")).json();
    document.getElementById("next").textContent = state.next.command ? `Next: ${state.next.reason}.` : `Nothing to do: ${state.next.reason}.`;
    document.body.dataset.state = state.next.state;
    running = state.running;
    document.getElementById("running").hidden = !running;
    document.body.dataset.running = running ? running.step : "";
    if (running) document.getElementById("what").textContent = `${running.person} started ${running.step} at ${running.started}: ${running.stopped_by ? `being stopped by ${running.stopped_by}` : running.what || "starting"}`;
    document.getElementById("stop").disabled = Boolean(running?.stopped_by);
    if (state.version !== version) { const first = version < 0; version = state.version; if (!first) await show(tab, true); }
    lock();
    document.body.dataset.ended = state.ended;
  } catch (problem) { document.getElementById("next").textContent = `The server does not answer (${problem.message}).`; }
  polling = setTimeout(poll, running ? 300 : 2000);
}

function csv(table) {
  const cell = one => { const text = one.innerText.trim(); return /[",\n]/.test(text) ? `"${text.replaceAll('"', '""')}"` : text; };
  return [...table.rows].map(row => [...row.cells].map(cell).join(",")).join("\n") + "\n";
}

function save(name, content, type) {
  const link = document.createElement("a");
  link.href = typeof content === "string" && content.startsWith("data:") ? content : `data:${type};charset=utf-8,${encodeURIComponent(content)}`;
  link.download = name;
  link.click();
}

function png(figure) {  // the chart with its present colours
  const svg = figure.querySelector("svg"), copy = svg.cloneNode(true), originals = svg.querySelectorAll("*");
  copy.querySelectorAll("*").forEach((one, number) => { for (const name of ["fill", "stroke", "stroke-width", "stroke-dasharray", "font-size", "font-family"]) one.style.setProperty(name, getComputedStyle(originals[number]).getPropertyValue(name)); });
  copy.setAttribute("width", 1200); copy.setAttribute("height", 600);
  const picture = new Image(), canvas = Object.assign(document.createElement("canvas"), { width: 1200, height: 600 });
  picture.onload = () => { const pen = canvas.getContext("2d"); pen.fillStyle = getComputedStyle(document.body).backgroundColor; pen.fillRect(0, 0, 1200, 600); pen.drawImage(picture, 0, 0); save("accuracy.png", canvas.toDataURL("image/png")); };
  picture.src = "data:image/svg+xml;charset=utf-8," + encodeURIComponent(new XMLSerializer().serializeToString(copy));
}

document.querySelector("nav").addEventListener("click", event => { if (event.target.dataset.tab) show(event.target.dataset.tab); });
document.querySelector("nav").addEventListener("keydown", event => {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key], all = [...document.querySelectorAll("[role=tab]")];
  if (step) { const one = all[(all.findIndex(one => one.dataset.tab === tab) + step + all.length) % all.length]; one.focus(); show(one.dataset.tab); }
});
document.getElementById("stop").addEventListener("click", () => steps("stop", { ended: document.body.dataset.ended }).then(poll));
content.addEventListener("submit", event => { event.preventDefault(); start(event.target); });
content.addEventListener("input", event => { if (event.target.form) say(event.target.form); });
content.addEventListener("change", event => { if (event.target.id === "files") propose(); else if (event.target.form) say(event.target.form); });
content.addEventListener("click", event => {
  const one = event.target;
  if (one.dataset.copy !== undefined) navigator.clipboard?.writeText(one.parentElement.querySelector("code").textContent);
  if (one.dataset.csv !== undefined) save("table.csv", csv(one.parentElement.querySelector("table")), "text/csv");
  if (one.dataset.png !== undefined) png(one.closest("figure"));
  if (one.dataset.again !== undefined) propose(one.form);
});
await show(document.getElementById("tab-" + tab) ? tab : "status");
await poll();
