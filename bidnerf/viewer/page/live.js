// What only a server can do: localize photos, and render the field from here.
import { element, find } from "./data.js";

const SETTLED = 250; // ms without motion after which the field is rendered finely
const QUICK = 360,
  FINE = [128, 256, 512, 1024]; // pixels of the longer side
const LARGEST = 32 * 2 ** 20,
  LONGEST = 200;

export class Live {
  constructor(page) {
    this.page = page;
    this.queries = page.state.queries;
    this.on = false;
    const choose = find("choose"),
      drop = find("drop");
    choose.hidden = find("fov").hidden = false;
    if (page.state.hfov !== null) find("hfov").value = page.state.hfov;
    if (page.state.camera_given) find("hfov").placeholder = "as given";
    find("photo").addEventListener("change", (event) => {
      for (const file of event.target.files) this.upload(file);
      event.target.value = "";
    });
    let inside = 0;
    document.addEventListener("dragenter", (event) => {
      if (event.dataTransfer?.types.includes("Files")) {
        inside++;
        drop.hidden = false;
      }
    });
    document.addEventListener("dragleave", () => {
      inside = Math.max(0, inside - 1);
      drop.hidden = inside === 0;
    });
    document.addEventListener("dragover", (event) => event.preventDefault());
    document.addEventListener("drop", (event) => {
      event.preventDefault();
      inside = 0;
      drop.hidden = true;
      for (const file of event.dataTransfer.files) this.upload(file);
    });
    if (page.space) {
      find("toggles").append(
        element(
          "button",
          {
            id: "show-field",
            "aria-pressed": "false",
            title: "Field from here (v)",
            onclick: () => this.toggleField(),
          },
          "Field",
        ),
      );
      page.space.moved = () => this.moved();
    }
    new ResizeObserver(() => this.moved()).observe(find("scene"));
  }

  thumbnail(number) {
    return `/api/thumbnail/${number}`;
  }

  listQueries(select) {
    const open = this.queries.map((name, i) => [name, i]).filter(([name]) => this.page.placeOf(name) < 0);
    if (!open.length) return;
    select.append(
      element(
        "optgroup",
        { label: "Not localized yet" },
        ...open.map(([name, i]) => element("option", { value: `query ${i}` }, name)),
      ),
    );
    if (this.page.current < 0)
      select.prepend(element("option", { value: "", disabled: true, selected: true }, "Choose an image"));
  }

  turn(by) {
    if (!this.queries.length) return false;
    const here = this.queries.indexOf(this.waiting ?? this.page.answer?.name),
      count = this.queries.length;
    const next = here < 0 ? (by > 0 ? 0 : count - 1) : (here + by + count) % count;
    const known = this.page.placeOf(this.queries[next]);
    if (known >= 0) {
      this.waiting = null;
      this.page.select(known);
    } else this.localizeQuery(next);
    return true;
  }

  localizeQuery(number) {
    return this.ask(`/api/query/${number}`, this.queries[number]);
  }

  upload(file) {
    if (file.size > LARGEST) {
      this.page.note(`${file.name} has ${Math.round(file.size / 2 ** 20)} MiB, at most 32 are accepted.`);
      return null;
    }
    const name = file.name.slice(0, LONGEST) || "photo";
    const hfov = find("hfov");
    if (!hfov.checkValidity()) {
      this.page.note("The field of view is a number of degrees from 1 to 170.");
      return null;
    }
    const camera = hfov.value ? `&hfov=${encodeURIComponent(hfov.value)}` : "";
    return this.ask(`/api/photo?name=${encodeURIComponent(name)}${camera}`, name, file);
  }

  async ask(path, name, body = null) {
    this.waiting = name;
    this.page.note("");
    this.page.progress(`${name}: waiting`);
    try {
      const reply = await fetch(path, {
        method: "POST",
        body,
        headers: body ? { "Content-Type": "application/octet-stream" } : {},
      });
      const accepted = await reply.json();
      if (!reply.ok) throw new Error(accepted.detail);
      await this.watch(accepted.job, name);
    } catch (error) {
      this.page.note(`${name}: ${error.message}`);
    }
    this.page.progress("");
    if (this.waiting === name) this.waiting = null;
  }

  async watch(id, name) {
    let known = "";
    const began = performance.now();
    for (;;) {
      const reply = await fetch(`/api/job/${id}?known=${known}`),
        job = await reply.json();
      if (!reply.ok) throw new Error(job.detail);
      if (job.answer && (job.state === "rendering" || job.state === "done")) this.page.add(job.answer);
      if (job.state === "done") break;
      known = job.state;
      const seconds = `${((performance.now() - began) / 1000).toFixed(0)} s`;
      const doing = { waiting: "waiting", searching: job.caption || "searching", rendering: "rendering the field" }[
        job.state
      ];
      this.page.progress(`${name}: ${doing} (${seconds})`);
      await new Promise((resolve) => setTimeout(resolve, 200));
    }
  }

  toggleField() {
    if (!this.page.space) return;
    this.on = !this.on;
    find("show-field").setAttribute("aria-pressed", String(this.on));
    if (this.on) this.moved();
    else {
      this.abort?.abort();
      clearTimeout(this.timer);
      find("field").hidden = true;
      this.page.space.show("surface", !this.page.hidden.has("surface"));
    }
  }

  // The camera has moved: what is being rendered is no longer wanted.
  moved() {
    if (!this.on) return;
    this.stamp = (this.stamp ?? 0) + 1;
    if (this.fine) this.abort?.abort();
    find("field").classList.add("stale");
    this.page.space.show("surface", !this.page.hidden.has("surface"));
    clearTimeout(this.timer);
    this.timer = setTimeout(() => this.render(FINE), SETTLED);
    if (!this.busy) this.render([]);
  }

  // Render once quickly, then ever finer as long as the camera rests.
  async render(sizes) {
    if (!this.on) return;
    const stamp = this.stamp;
    this.busy = true;
    this.fine = sizes.length > 0;
    for (const size of sizes.length ? sizes : [QUICK]) {
      const box = find("scene").getBoundingClientRect(),
        scale = size / Math.max(box.width, box.height);
      this.abort = new AbortController();
      try {
        const reply = await fetch("/api/view", {
          method: "POST",
          signal: this.abort.signal,
          body: JSON.stringify({
            pose: this.page.space.pose(),
            fov: this.page.space.camera.fov,
            quick: !sizes.length,
            width: Math.max(1, Math.round(scale * box.width)),
            height: Math.max(1, Math.round(scale * box.height)),
          }),
        });
        if (!reply.ok) throw new Error((await reply.json()).detail);
        const url = URL.createObjectURL(await reply.blob());
        if (stamp !== this.stamp || !this.on) {
          URL.revokeObjectURL(url);
          break;
        }
        await this.showField(url);
      } catch (error) {
        if (error.name !== "AbortError") this.page.note(error.message);
        break;
      }
    }
    this.busy = false;
    if (stamp !== this.stamp && !sizes.length) this.render([]);
  }

  async showField(url) {
    const field = find("field"),
      before = field.src;
    field.src = url;
    await field.decode();
    field.hidden = false;
    field.classList.remove("stale");
    this.page.space.show("surface", false);
    this.shown = (this.shown ?? 0) + 1;
    if (before.startsWith("blob:")) URL.revokeObjectURL(before);
  }
}
