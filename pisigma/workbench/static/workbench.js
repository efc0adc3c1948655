// The page of a cell: tabs, forms that start steps, progress. Everything shown is made by the server; nothing is computed here.
const content = document.getElementById("content"), person = document.getElementById("person");
let tab = location.hash.slice(1), wanted = tab, version = -1, ended = 0, running = null;

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

const kept = {};  // the forms of every tab as people left them, and what else a tab had open
const refusals = {};  // the last refusal of every step that was started here
const started = {};  // the form by which a step was started here, and the number of steps that had ended by then
let proposal = null, dragging = 0;

const keyOf = form => `${form.dataset.step} ${form.dataset.name || form.dataset.command}`;

const storeOf = name => `${document.body.dataset.cell} ${name}`;

function store() {  // what was typed in a tab survives a reload
  const found = {};
  for (const form of content.querySelectorAll("form:not([data-fixed])")) {
    const edited = [...form.elements].filter(one => one.name && one.type !== "file" && isEdited(one));
    if (form.elements.seen && edited.length) edited.push(form.elements.seen);
    if (edited.length) found[keyOf(form)] = edited.map(one => [one.name, one.type === "checkbox" ? one.checked : one.value]);
  }
  sessionStorage.setItem(storeOf(tab), JSON.stringify(found));
}

function openAround(field) {
  for (let one = field.closest("details"); one; one = one.parentElement.closest("details")) one.open = true;
}

function fill(form, fields) {
  for (const [name, value] of fields) {
    const one = form.elements[name];
    if (one && !one.hidden) openAround(one);
    if (one?.type === "checkbox") one.checked = value;
    else if (one && (!one.options || [...one.options].some(choice => choice.value === value))) one.value = value;
  }
}

function keep(parts, forms, typed) {  // a form that the server sends unchanged stays as it is; else what was typed is copied
  for (const form of parts.querySelectorAll("form")) {
    const key = keyOf(form), before = forms[key], served = form.outerHTML;
    if (before?.served === served) form.replaceWith(before.form);
    else {
      if (before) copy(before.form, form);
      else if (typed[key]) fill(form, typed[key]);
      forms[key] = { form, served };
    }
  }
}

const nameOf = details => details.dataset.name || details.querySelector("summary").textContent;

let shows = 0;
async function show(name) {
  wanted = name;
  const turn = ++shows;
  const text = await (await ask(`tab/${name}`)).text(), parts = document.createElement("div");
  if (turn !== shows) return;  // another tab was chosen, or this one was fetched again, meanwhile
  const top = name === tab ? content.scrollTop : 0;
  parts.innerHTML = text;
  if (kept[tab]) kept[tab].open = [...content.querySelectorAll("details[open]")].map(nameOf);
  const left = kept[name] ||= { forms: {}, open: [] };
  const typed = JSON.parse(sessionStorage.getItem(storeOf(name)) || "{}");
  let refused = "";
  for (const one of parts.querySelectorAll(".outcome")) if (started[one.dataset.step]?.ended < ended) {
    const { form } = started[one.dataset.step];
    delete started[one.dataset.step];
    if (one.classList.contains("refused")) { refused = refusals[one.dataset.step] = one.outerHTML; continue; }
    if (form.dataset.once !== undefined) { delete left.forms[keyOf(form)]; delete typed[keyOf(form)]; }
    if (one.dataset.step === "import") proposal = null;
  }
  keep(parts, left.forms, typed);
  if (proposal) parts.querySelector("#proposal")?.append(proposal);
  content.replaceChildren(...parts.childNodes);
  content.querySelectorAll("details").forEach(one => { one.open ||= left.open.includes(nameOf(one)); });
  content.scrollTop = top;
  tab = name;
  for (const button of document.querySelectorAll("[role=tab]")) {
    const chosen = button.dataset.tab === name;
    button.setAttribute("aria-selected", chosen);
    button.tabIndex = chosen ? 0 : -1;
  }
  history.replaceState(null, "", "#" + name);
  content.setAttribute("aria-labelledby", "tab-" + name);
  content.querySelectorAll("small.fault").forEach(one => one.remove());
  content.querySelectorAll("[aria-invalid]").forEach(one => one.removeAttribute("aria-invalid"));
  content.querySelectorAll(".outcome[data-field]").forEach(one => { if (refusals[one.dataset.step] === one.outerHTML) mark(one, refused === one.outerHTML); });
  content.querySelectorAll("form").forEach(say);
  lock();
  store();
}

let place = null;  // what has the focus in a tab
document.addEventListener("focusin", ({ target }) => { place = content.contains(target) ? { target, tab, key: target.form && keyOf(target.form), name: target.name } : null; });

function focusAgain() {  // forms that were replaced, and buttons that were locked, have lost it
  if (place?.tab !== tab || document.activeElement !== document.body) return;
  const form = kept[tab]?.forms[place.key]?.form;
  (content.contains(place.target) ? place.target : form?.elements[place.name] || form?.querySelector("[type=submit]"))?.focus({ preventScroll: true });
}

function isEdited(one) {
  if (one.type === "checkbox") return one.checked !== one.defaultChecked;
  if (one.options) return one.selectedIndex !== Math.max(0, [...one.options].findIndex(choice => choice.defaultSelected));
  return one.type !== "hidden" && !one.hidden && one.value !== one.defaultValue;
}

// What was typed stays, with the digest of the file that it was made from, until it has been saved.
function copy(before, form) {
  let isNew = false;
  for (const one of before.elements) {
    const other = form.elements[one.name];
    if (form.dataset.fixed !== undefined || !other?.form || !isEdited(one)) continue;
    if (one.type === "file") other.files = one.files;
    else if (one.type === "checkbox") other.checked = one.checked;
    else if (!one.options || [...other.options].some(choice => choice.value === one.value)) other.value = one.value;
    isNew ||= isEdited(other);
  }
  if (isNew && form.elements.seen) form.elements.seen.value = before.elements.seen.value;
}

function values(form) {
  const found = {};
  for (const one of form.elements) {
    if (!one.name || one.type === "file" || (one.type === "checkbox" && !one.checked)) continue;
    if (one.value !== "" || form.dataset.all !== undefined) found[one.name] = one.value;
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
    const value = one.type === "file" ? one.files[0]?.name || "" : one.value;
    if (one.dataset.word !== undefined && value) line += ` ${quoted(value)}`;
    else if (!option || one.value === "" || (one.type === "checkbox" && !one.checked)) continue;
    else if (one.dataset.kind === "list") line += one.value.trim().split(/\s+/).map(word => ` ${option}${quoted(word)}`).join("");
    else if (/[=/]$/.test(option)) line += ` ${option}${quoted(one.value)}`;
    else if (one.dataset.kind === "flag") line += one.value === "true" ? ` ${option}` : ` --no-${option.slice(2)}`;
    else if (one.dataset.kind === "switch") line += ` ${option}`;
    else line += ` ${option} ${quoted(value)}`;
  }
  if (form.elements.export?.value === "") line += " --export none";
  const folder = quoted(document.body.dataset.folder), day = form.elements.session?.selectedOptions?.[0]?.dataset.day;
  if (day) line += ` ${quoted(`${document.body.dataset.folder}/sessions/${form.elements.session.value}.csv`)} --cell ${folder} --date ${day}`;
  if (form.dataset.rows !== undefined) line += ` --rows ${quoted(`${document.body.dataset.folder}/sessions/${form.elements.session.value}.csv`)}`;
  if (form.dataset.pose !== undefined) line += " --pose " + [...form.querySelectorAll("input")].map(one => one.value || "0").join(" ");
  const stated = [...form.elements].filter(one => one.dataset.key && one.value.trim());
  if (stated.length) line += ` --map ${quoted(stated.map(one => `${one.dataset.key}=${one.value.trim()}`).join(","))}`;
  if (form.dataset.proposal !== undefined) line += ` --cell ${folder} --yes`;
  const isOne = new Set(stated.map(one => one.dataset.file)).size < 2;
  code.textContent = isOne ? line : "";  // a command has one --map for all files
}

function fault(form, problem) {
  const shown = form.querySelector("p.fault");
  shown.textContent = problem ? problem.message : "";
  shown.hidden = !problem;
  if (problem?.field) point(form, problem.field)?.focus();
}

function point(form, name) {  // show which field is at fault
  const field = form.elements[name] || form.elements[name.replace(/^(--set )?(--)?/, "").replaceAll("-", "_")];
  if (!field?.closest) return null;
  openAround(field);
  field.setAttribute("aria-invalid", true);
  return field;
}

function mark(outcome, isNew) {  // put the reason of a refusal next to its field
  for (const form of content.querySelectorAll(`form[data-step="${outcome.dataset.step}"]`)) {
    const field = point(form, outcome.dataset.field), text = outcome.querySelector(".refusal")?.textContent;
    if (!field || !text || field.parentElement.querySelector(".fault")) continue;
    if (isNew) field.focus();
    field.after(Object.assign(document.createElement("small"), { className: "fault", textContent: text }));
  }
}

async function upload(file, more = "") {
  const answer = await ask(`upload?name=${encodeURIComponent(file.name)}${more}`, file, "application/octet-stream");
  return await answer.json();
}

async function offer(input) {  // the links of a robot file, which replaces a robot of the catalogue and the other way round
  fault(input.form, null);
  const file = input.files?.[0], other = input.form.querySelector("[data-links]");
  if (other !== input) { if (input.value) other.value = ""; else if (other.files.length) return; }
  try {
    const links = file ? (await upload(file, "&links")).links : [];
    for (const name of ["tip", "base"]) input.form.elements[name].replaceChildren(input.form.elements[name].options[0], ...links.map(link => new Option(link, link)));
    if (file) input.form.elements.robot.value = "";
  } catch (problem) { fault(input.form, problem); }
  say(input.form);
}

async function start(form) {
  let step = null;
  fault(form, null);
  try {
    const fields = { ...values(form), command: form.querySelector(".command code")?.textContent || "" };
    if (form.dataset.go !== undefined) return show(form.dataset.tabOf);
    for (const one of form.querySelectorAll("[data-upload]")) if (one.files.length) fields[one.dataset.upload] = (await upload(one.files[0])).file;
    step = form.dataset.step;
    started[step] = { form, ended };  // before the answer: the step may end before it arrives
    await steps(`step/${step}`, fields);
    step = null;
    if (form.dataset.tabOf && form.dataset.tabOf !== tab) await show(form.dataset.tabOf);
    await poll();
  } catch (problem) { if (step) delete started[step]; fault(form, problem); }
}

async function uploaded(files) {
  const numbers = [];
  document.getElementById("proposal").textContent = "";
  for (const file of files) numbers.push((await upload(file)).file);
  if (numbers.length) await propose({ files: numbers.join(",") });
}

async function propose(fields) {  // how the columns are read at once, then what the check of the rows finds
  const where = document.getElementById("proposal"), shown = document.getElementById("upload-fault"), body = JSON.stringify(fields);
  shown.hidden = true;
  try {
    where.innerHTML = await (await ask("propose", body)).text();
    const form = proposal = where.querySelector("form");
    for (const one of form.elements) if (one.name in fields && one.type !== "hidden") { if (one.type === "checkbox") one.checked = true; else one.value = fields[one.name]; }
    say(form);
    lock();
    const found = await (await ask("check", body)).text();
    if (form.isConnected) form.querySelector("#findings").innerHTML = found;
  } catch (problem) { shown.textContent = problem.message; shown.hidden = false; }
}

function lock() {
  content.querySelectorAll("form button[type=submit]").forEach(one => { one.disabled = running !== null && one.closest("form").dataset.go === undefined; });
  focusAgain();
}

const alone = ["no_cell", "broken_cell"];  // states with a tab of their own
let polling = null, showing = null;
async function poll() {
  clearTimeout(polling);
  try {
    const state = await (await ask(`state?version=${version}`)).json();
    document.getElementById("next").textContent = alone.includes(state.next.state) || state.next.command ? `Next: ${state.next.reason}.` : `Nothing to do: ${state.next.reason}.`;
    const before = document.body.dataset.state;
    if (before && before !== state.next.state && (alone.includes(before) || alone.includes(state.next.state))) return location.reload();
    document.body.dataset.state = state.next.state;
    running = state.running;
    document.getElementById("running").hidden = !running;
    document.body.dataset.running = running ? running.step : "";
    if (running) document.getElementById("what").textContent = `${running.person} started ${running.step} at ${running.started}: ${running.stopped_by ? `being stopped by ${running.stopped_by}` : running.what || "starting"}`;
    document.getElementById("stop").disabled = Boolean(running?.stopped_by);
    ended = state.ended;
    if (state.version !== version) { const first = version === -1; version = state.version; if (!first) showing = show(wanted).catch(() => { version = -2; }); }
    await showing;  // also if another poll has started it: an end is told after its result is shown
    lock();
    if (state.dragged.turn !== dragging) dragging = 0;
    for (const [name, value] of Object.entries(dragging ? state.dragged.values : {})) for (const one of content.querySelectorAll(`[name="${name}"]`)) one.value = value;
    document.body.dataset.ended = ended;
  } catch (problem) { document.getElementById("next").textContent = `The server does not answer (${problem.message}).`; }
  polling = setTimeout(poll, running ? 10 : dragging ? 300 : 2000);
}

document.querySelector("nav").addEventListener("click", event => { if (event.target.dataset.tab) show(event.target.dataset.tab); });
document.querySelector("nav").addEventListener("keydown", event => {
  const step = { ArrowRight: 1, ArrowLeft: -1 }[event.key], all = [...document.querySelectorAll("[role=tab]")];
  if (step) { const one = all[(all.findIndex(one => one.dataset.tab === tab) + step + all.length) % all.length]; one.focus(); show(one.dataset.tab); }
});
document.getElementById("stop").addEventListener("click", () => steps("stop", { ended: String(ended) }).then(poll));
content.addEventListener("submit", event => { event.preventDefault(); start(event.target); });
content.addEventListener("input", event => { if (event.target.form) say(event.target.form); store(); });
content.addEventListener("change", event => { if (event.target.id === "files") uploaded(event.target.files); else if (event.target.matches("[data-links], [data-step=new] [name=robot]")) offer(event.target); else if (event.target.form) say(event.target.form); });
content.addEventListener("click", event => {
  const one = event.target;
  if (one.dataset.again !== undefined) propose(values(one.form));
  if (one.dataset.repair !== undefined) propose({ ...values(one.form), ...JSON.parse(one.dataset.repair) });
  if (one.dataset.show !== undefined) ask("show", JSON.stringify({ text: one.dataset.show }));
  if (one.dataset.typed !== undefined) uploaded([new File([document.getElementById("typed").value], "typed.csv")]);
  if (one.dataset.growing !== undefined) propose({ files: "growing" });
  if (one.dataset.clear !== undefined) { for (const field of one.closest("fieldset").elements) field.value = ""; }
  if (one.dataset.discard !== undefined) { kept[tab].forms = {}; sessionStorage.removeItem(storeOf(tab)); show(tab); if (dragging) steps("drag", {}); }
  if (one.dataset.drag !== undefined) steps("drag", { on: "true" }).then(async answer => { dragging = (await answer.json()).turn; poll(); }, problem => fault(one.form, problem));
});
await show(document.getElementById("tab-" + tab) ? tab : document.querySelector("[role=tab]").dataset.tab);
await poll();
