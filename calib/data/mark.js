// The marking page. Positions are in pixels of the photo as stored, (0, 0) at the corner of the first one;
// how the photo is shown (moved, enlarged, turned) never touches them.
"use strict";
(() => {
  const $ = (id) => document.getElementById(id);
  const view = $("view"), loupe = $("loupe"), said = $("said");
  const ORANGE = "#ff8c1a", BLUE = "#39a0ff", RED = "#ff3b30";
  const LARGEST = 64, TILES_KEPT = 400, DRAG_FROM = 4, LOUPE = 8, LOOK_AHEAD_MS = 1500;
  const SNAP_REACH = 12, LEAST_REACH = 3, MOST_REACH = 20;  // The first on the screen, the others in the photo.

  let state = null, photo = 0, point = 0;
  let marks = [];  // By photo: Map of point name to [u, v].
  let predicted = prediction();
  let pointer = null;  // In the photo.
  const looks = [];  // By photo: {scale, u, v, turn}, (u, v) in the middle.
  const history = [];
  let queue = Promise.resolve();
  const tiles = new Map();
  let ahead = 0;

  function prediction(got) {
    return { pixels: new Map(Object.entries(got?.pixels ?? {})), doubtful: got?.doubtful ?? [] };
  }

  // --- Geometry ---------------------------------------------------------------------------------

  const size = (canvas) => ({ w: canvas.clientWidth, h: canvas.clientHeight });

  function turned(x, y, turn) {
    return [[x, y], [-y, x], [-x, -y], [y, -x]][turn];
  }

  function toScreen(look, canvas, u, v) {
    const [x, y] = turned((u - look.u) * look.scale, (v - look.v) * look.scale, look.turn);
    const { w, h } = size(canvas);
    return [x + w / 2, y + h / 2];
  }

  function toPhoto(look, canvas, x, y) {
    const { w, h } = size(canvas);
    const [a, b] = turned(x - w / 2, y - h / 2, (4 - look.turn) % 4);
    return [look.u + a / look.scale, look.v + b / look.scale];
  }

  function whole(number, turn) {
    const { width, height } = state.photos[number];
    const { w, h } = size(view);
    const [across, down] = turn % 2 ? [height, width] : [width, height];
    return { scale: 0.98 * Math.min(w / across, h / down), u: width / 2, v: height / 2, turn };
  }

  function look() {
    looks[photo] ??= whole(photo, state.photos[photo].turn);
    return looks[photo];
  }

  function zoom(factor, x, y) {
    const { w, h } = size(view), at = look();
    const [u, v] = toPhoto(at, view, x ?? w / 2, y ?? h / 2);
    const least = Math.min(1, whole(photo, at.turn).scale) / 2;
    at.scale = Math.min(Math.max(at.scale * factor, least), LARGEST);
    const [u2, v2] = toPhoto(at, view, x ?? w / 2, y ?? h / 2);
    at.u += u - u2;
    at.v += v - v2;
    draw();
  }

  function pan(dx, dy) {
    const at = look(), [a, b] = turned(dx, dy, (4 - at.turn) % 4);
    const { width, height } = state.photos[photo];
    at.u = Math.min(Math.max(at.u + a / at.scale, 0), width);
    at.v = Math.min(Math.max(at.v + b / at.scale, 0), height);
    draw();
  }

  function goTo(uv, scale) {
    const at = look();
    [at.u, at.v] = uv;
    at.scale = Math.max(at.scale, scale);
    draw();
  }

  // --- Drawing ----------------------------------------------------------------------------------

  function tile(number, level, column, row) {
    const key = `photo/${number}/tile/${level}/${column}/${row}`;
    let image = tiles.get(key);
    if (image) {
      tiles.delete(key);
    } else {
      image = new Image();
      image.onload = draw;
      image.onerror = () => { if (!image.failed) { image.failed = true; explain(key); } };
      image.src = key;
    }
    tiles.set(key, image);
    if (tiles.size > TILES_KEPT) tiles.delete(tiles.keys().next().value);
    return image;
  }

  async function explain(key) {
    try {
      const answer = await fetch(key);
      const data = await answer.json();
      say(data.error || "The photo cannot be shown.", true);
    } catch {
      gone();
    }
  }

  function levelSizes(number) {
    let { width, height } = state.photos[number];
    const found = [[width, height]];
    while (Math.max(width, height) > state.tile_px) {
      [width, height] = [Math.floor((width + 1) / 2), Math.floor((height + 1) / 2)];
      found.push([width, height]);
    }
    return found;
  }

  function drawPhoto(canvas, at) {
    const { w, h } = size(canvas), ratio = window.devicePixelRatio || 1;
    if (canvas.width !== Math.round(w * ratio) || canvas.height !== Math.round(h * ratio)) {
      canvas.width = Math.round(w * ratio);
      canvas.height = Math.round(h * ratio);
    }
    const pen = canvas.getContext("2d"), { width, height } = state.photos[photo];
    pen.setTransform(ratio, 0, 0, ratio, 0, 0);
    pen.clearRect(0, 0, w, h);
    const corners = [[0, 0], [w, 0], [0, h], [w, h]].map(([x, y]) => toPhoto(at, canvas, x, y));
    const [u0, u1] = [Math.min(...corners.map((c) => c[0])), Math.max(...corners.map((c) => c[0]))];
    const [v0, v1] = [Math.min(...corners.map((c) => c[1])), Math.max(...corners.map((c) => c[1]))];
    pen.save();
    pen.translate(w / 2, h / 2);
    pen.rotate(at.turn * Math.PI / 2);
    pen.scale(at.scale, at.scale);
    pen.translate(-at.u, -at.v);
    pen.imageSmoothingEnabled = at.scale * ratio < 2;
    pen.imageSmoothingQuality = "high";
    const levels = levelSizes(photo), coarse = levels.length - 1;
    const fine = Math.min(coarse, Math.max(0, Math.floor(Math.log2(1 / (at.scale * ratio)) + 0.01)));
    const small = $("photos").children[photo].querySelector("img");
    if (small.complete && small.naturalWidth) pen.drawImage(small, 0, 0, width, height);
    // The coarsest first: it is there at once, and lies under finer ones still on their way.
    for (const level of coarse === fine ? [fine] : [coarse, fine]) {
      const [lw, lh] = levels[level], fu = width / lw, fv = height / lh, t = state.tile_px;
      const first = [Math.max(0, Math.floor(u0 / fu / t)), Math.max(0, Math.floor(v0 / fv / t))];
      const last = [Math.min(Math.ceil(lw / t) - 1, Math.floor(u1 / fu / t)), Math.min(Math.ceil(lh / t) - 1, Math.floor(v1 / fv / t))];
      for (let row = first[1]; row <= last[1]; row++) {
        for (let column = first[0]; column <= last[0]; column++) {
          const image = tile(photo, level, column, row);
          if (image.complete && image.naturalWidth) {
            pen.drawImage(image, column * t * fu, row * t * fv, image.naturalWidth * fu, image.naturalHeight * fv);
          }
        }
      }
    }
    pen.restore();
    return pen;
  }

  function cross(pen, [x, y], colour, reach, dashed) {
    for (const [stroke, width] of [["#000", 3], [colour, 1.25]]) {
      pen.strokeStyle = stroke;
      pen.lineWidth = width;
      pen.setLineDash(dashed ? [4, 3] : []);
      pen.beginPath();
      pen.arc(x, y, reach, 0, 2 * Math.PI);
      pen.stroke();
      pen.setLineDash([]);
      pen.beginPath();
      for (const [dx, dy] of [[1, 0], [-1, 0], [0, 1], [0, -1]]) {
        pen.moveTo(x + 3 * dx, y + 3 * dy);
        pen.lineTo(x + (reach + 4) * dx, y + (reach + 4) * dy);
      }
      pen.stroke();
    }
  }

  function label(pen, [x, y], text, colour) {
    pen.font = "600 13px system-ui, sans-serif";
    pen.lineJoin = "round";
    pen.lineWidth = 4;
    pen.strokeStyle = "#000";
    pen.strokeText(text, x + 14, y - 10);
    pen.fillStyle = colour;
    pen.fillText(text, x + 14, y - 10);
  }

  let waiting = false;
  function draw() {
    if (waiting) return;
    waiting = true;
    requestAnimationFrame(() => { waiting = false; drawNow(); });
  }

  function drawNow() {
    const at = look(), pen = drawPhoto(view, at), current = state.points[point].name;
    for (const [name, uv] of predicted.pixels) {
      if (marks[photo].has(name)) continue;
      const place = toScreen(at, view, ...uv);
      cross(pen, place, name === current ? ORANGE : "#fff", name === current ? 14 : 9, true);
      label(pen, place, `${name}?`, name === current ? ORANGE : "#fff");
    }
    for (const [name, uv] of marks[photo]) {
      const place = toScreen(at, view, ...uv);
      const colour = predicted.doubtful.includes(name) ? RED : name === current ? ORANGE : BLUE;
      cross(pen, place, colour, name === current ? 10 : 7, false);
      label(pen, place, name, colour);
    }
    const mark = marks[photo].get(current);
    const uv = pointer ?? mark ?? predicted.pixels.get(current);
    const close = { ...(uv ? { u: uv[0], v: uv[1] } : at), turn: at.turn, scale: Math.max(LOUPE, at.scale) };
    const pen2 = drawPhoto(loupe, close);
    if (uv) {
      for (const [name, place] of marks[photo]) {
        cross(pen2, toScreen(close, loupe, ...place), name === current ? ORANGE : BLUE, 12, false);
      }
      if (pointer) {
        const { w, h } = size(loupe);
        pen2.strokeStyle = "#fff";
        pen2.lineWidth = 1;
        pen2.strokeRect(w / 2 - 2, h / 2 - 2, 4, 4);
      }
    }
    const [u, v] = uv ?? [];
    $("where").textContent = uv
      ? `${pointer ? "Pointer" : mark ? "Mark" : "Predicted"}: ${u.toFixed(2)}, ${v.toFixed(2)} px`
      : "";
  }

  // --- Lists ------------------------------------------------------------------------------------

  function make(tag, text, name) {
    const node = document.createElement(tag);
    if (text !== undefined) node.textContent = text;
    if (name) node.className = name;
    return node;
  }

  function buildLists() {
    state.photos.forEach((one, number) => {
      const item = make("li"), image = make("img");
      image.loading = "lazy";
      image.alt = "";
      image.onerror = () => { image.style.visibility = "hidden"; };
      image.src = `photo/${number}/thumb`;
      if (one.turn) image.style.transform = `rotate(${90 * one.turn}deg) scale(${one.turn % 2 ? 0.6 : 1})`;
      item.append(image, make("span", one.name), make("div", "", "number"));
      item.title = one.name;
      item.onclick = () => show(number, point);
      $("photos").append(item);
    });
    state.points.forEach((one, number) => {
      const item = make("li"), name = make("span", one.name);
      if (one.check) name.append(make("small", " check"));
      if (!one.known) name.append(make("small", " no coordinates"));
      item.append(make("span", "", "state"), name, make("span", "", "count"));
      item.onclick = () => show(photo, number, true);
      $("points").append(item);
    });
  }

  const many = (count, one) => `${count} ${one}${count === 1 ? "" : "s"}`;

  function lists() {
    [...$("photos").children].forEach((item, number) => {
      item.setAttribute("aria-current", number === photo);
      item.querySelector(".number").textContent = many(marks[number].size, "mark");
    });
    [...$("points").children].forEach((item, number) => {
      const { name } = state.points[number], sign = item.querySelector(".state");
      const here = marks[photo].has(name), wrong = predicted.doubtful.includes(name);
      item.setAttribute("aria-current", number === point);
      sign.className = `state ${wrong ? "doubtful" : here ? "marked" : ""}`;
      sign.textContent = wrong ? "!" : here ? "\u2713" : predicted.pixels.has(name) ? "?" : "";
      sign.title = wrong ? "does not fit the other marks" : here ? "marked here" : sign.textContent && "predicted here";
      item.querySelector(".count").textContent = many(marks.filter((m) => m.has(name)).length, "photo");
    });
    const { name } = state.points[point];
    $("point").textContent = name;
    $("photo").textContent = state.photos[photo].name;
    $("counts").textContent =
      `point ${point + 1} of ${state.points.length}, photo ${photo + 1} of ${state.photos.length}, ` +
      `${marks.reduce((sum, m) => sum + m.size, 0)} marks in all`;
    $("undo").disabled = history.length === 0;
    const others = [];
    marks.forEach((m, number) => { if (number !== photo && m.has(name) && others.length < 6) others.push(number); });
    $("others-section").hidden = others.length === 0;
    $("others").replaceChildren(...others.map((number) => {
      const figure = make("figure"), image = make("img"), [u, v] = marks[number].get(name);
      image.alt = image.title = `${name} in ${state.photos[number].name}`;
      image.onerror = () => figure.remove();
      image.src = `photo/${number}/cut/${Math.floor(u)}/${Math.floor(v)}`;
      figure.append(image);
      figure.onclick = () => show(number, point, true);
      return figure;
    }));
    window.history.replaceState(null, "", `#${photo}/${point}`);
  }

  function say(text, bad) {
    said.textContent = text;
    said.className = bad ? "bad" : "";
  }

  const gone = () => say("fieldcal does not answer. What was saved is in the file; run the command again to go on.", true);

  // --- Moving about -----------------------------------------------------------------------------

  function show(newPhoto, newPoint, near) {
    const other = newPhoto !== photo;
    photo = newPhoto;
    point = newPoint;
    $("photos").children[photo].scrollIntoView({ block: "nearest" });
    $("points").children[point].scrollIntoView({ block: "nearest" });
    const arrive = () => {
      const { name } = state.points[point], uv = marks[photo].get(name) ?? predicted.pixels.get(name);
      const { w, h } = size(view), at = look();
      if (uv && near) {
        const [x, y] = toScreen(at, view, ...uv);
        if (x < 0.1 * w || x > 0.9 * w || y < 0.1 * h || y > 0.9 * h) [at.u, at.v] = uv;
      }
      lists();
      draw();
    };
    if (!other) { arrive(); return; }
    say("");
    pointer = null;
    predicted = prediction();
    arrive();
    queue = queue.then(() => refresh(newPhoto)).then(arrive).catch(gone);
    clearTimeout(ahead);
    ahead = setTimeout(() => {
      // So that the next one is decoded already when it is wanted.
      const next = step(photo, 1, state.photos.length);
      tile(next, levelSizes(next).length - 1, 0, 0);
    }, LOOK_AHEAD_MS);
  }

  async function refresh(number) {
    const answer = await fetch(`photo/${number}/predicted`);
    if (number === photo && answer.ok) predicted = prediction(await answer.json());
  }

  const step = (number, by, count) => (number + by + count) % count;

  function nextOpen() {
    const open = (i) => !marks[photo].has(state.points[i].name);
    const sure = predicted.pixels.size > 0;
    for (let i = 1; i <= state.points.length; i++) {
      const candidate = (point + i) % state.points.length;
      if (open(candidate) && (!sure || X.pixels.has(name))) {
        show(photo, candidate, true);
        return;
      }
    }
    say("All points to be seen here are marked: Page Down for the next photo.");
  }

  // --- Changing marks ---------------------------------------------------------------------------

  async function post(what, data) {
    const answer = await fetch(what, {
      method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(data ?? {}),
    });
    const got = await answer.json();
    if (!answer.ok) throw new Error(got.error);
    return got;
  }

  const inTurn = (work) => {
    queue = queue.then(work).catch((error) => (error instanceof TypeError || error instanceof SyntaxError ? gone() : say(error.message, true)));
    return queue;
  };

  async function put(number, name, at, snap) {
    const got = await post("mark", { photo: number, point: name, at, snap_px: snap });
    if (got.at) marks[number].set(name, got.at); else marks[number].delete(name);
    if (number === photo) predicted = prediction(got.predicted);
    return got;
  }

  function tell(got, text) {
    if (got.not_saved) say(got.not_saved, true);
    else say(predicted.doubtful.length
      ? `${text} ${predicted.doubtful.join(", ")} ${predicted.doubtful.length === 1 ? "does" : "do"} not fit the other marks here.`
      : text);
    lists();
    draw();
  }

  function mark(at, snapping) {
    const number = photo, { name } = state.points[point];
    const reach = Math.min(Math.max(SNAP_REACH / look().scale, LEAST_REACH), MOST_REACH);
    // Shown at once; where it stays is told in a moment.
    const was = marks[number].get(name);
    marks[number].set(name, at);
    draw();
    return inTurn(async () => {
      const got = await put(number, name, at, snapping ? reach : null).catch((error) => {
        if (was) marks[number].set(name, was); else marks[number].delete(name);
        draw();
        throw error;
      });
      history.push({ number, name, before: got.before });
      const moved = Math.hypot(got.at[0] - at[0], got.at[1] - at[1]).toFixed(1);
      tell(got, got.onto ? `${name} marked on the ${got.onto}, ${moved} px away.`
        : snapping ? `${name} marked where you clicked: no target or corner near.` : `${name} marked.`);
    });
  }

  function nudge(dx, dy) {
    const number = photo, { name } = state.points[point], [a, b] = turned(dx, dy, (4 - look().turn) % 4);
    return inTurn(async () => {
      const from = marks[number].get(name);
      if (!from) { say("Mark the point first; the arrows move its mark."); return; }
      const { width, height } = state.photos[number];
      const clamp = (value, most) => Math.min(Math.max(value, 0), most);
      const got = await put(number, name, [clamp(from[0] + a, width), clamp(from[1] + b, height)], null);
      const last = history.at(-1);
      // A row of nudges is undone in one.
      if (!(last && last.nudged && last.number === number && last.name === name)) {
        history.push({ number, name, before: got.before, nudged: true });
      }
      pointer = null;
      tell(got, `${name} moved.`);
    });
  }

  function remove() {
    const number = photo, { name } = state.points[point];
    return inTurn(async () => {
      if (!marks[number].has(name)) return;
      const got = await put(number, name, null, null);
      history.push({ number, name, before: got.before });
      tell(got, `${name} removed.`);
    });
  }

  function undo() {
    return inTurn(async () => {
      const last = history.pop();
      if (!last) { say("Nothing to undo."); return; }
      const got = await put(last.number, last.name, last.before, null);
      tell(got, `Undone: ${last.name} in ${state.photos[last.number].name}.`);
    });
  }

  const save = () => inTurn(async () => { await post("save"); say(`Saved in ${state.file}.`); });

  const finish = () => inTurn(async () => {
    await post("finish");
    document.body.replaceChildren(make("p", `Done. The marks are in ${state.file}; fieldcal has ended. You can close this page.`, "done"));
    document.body.style.display = "block";
  });

  // --- Mouse and keys ---------------------------------------------------------------------------

  let pressed = null;
  const place = (event) => {
    const box = view.getBoundingClientRect();
    return [event.clientX - box.left, event.clientY - box.top];
  };
  const inside = ([u, v]) => u >= 0 && v >= 0 && u <= state.photos[photo].width && v <= state.photos[photo].height;

  function listen() {
    view.onpointerdown = (event) => {
      pressed = { x: event.clientX, y: event.clientY, moved: event.button !== 0 };
      view.setPointerCapture(event.pointerId);
    };
    view.onpointermove = (event) => {
      if (pressed) {
        const [dx, dy] = [event.clientX - pressed.x, event.clientY - pressed.y];
        if (pressed.moved || Math.hypot(dx, dy) > DRAG_FROM) {
          Object.assign(pressed, { moved: true, x: event.clientX, y: event.clientY });
          view.classList.add("moving");
          pan(-dx, -dy);
        }
      }
      const at = toPhoto(look(), view, ...place(event));
      pointer = inside(at) ? at : null;
      draw();
    };
    view.onpointerup = (event) => {
      const click = pressed && !pressed.moved;
      pressed = null;
      view.classList.remove("moving");
      const at = toPhoto(look(), view, ...place(event));
      if (click && inside(at)) mark(at, $("snap").checked);
    };
    view.onpointercancel = () => { pressed = null; view.classList.remove("moving"); };
    view.onpointerleave = () => { pointer = null; draw(); };
    view.oncontextmenu = (event) => event.preventDefault();
    view.addEventListener("wheel", (event) => {
      event.preventDefault();
      zoom(Math.exp(-event.deltaY * (event.deltaMode === 1 ? 0.05 : 0.0015)), ...place(event));
    }, { passive: false });
    for (const [id, act] of [["undo", undo], ["save", save], ["finish", finish]]) {
      // So that the keys go to the photo again.
      $(id).onclick = () => { act(); view.focus(); };
    }
    $("snap").onchange = () => view.focus();
    new ResizeObserver(draw).observe(view);
    document.addEventListener("keydown", key);
  }

  const ARROWS = { ArrowLeft: [-1, 0], ArrowRight: [1, 0], ArrowUp: [0, -1], ArrowDown: [0, 1] };
  const PANS = { a: [-1, 0], d: [1, 0], w: [0, -1], s: [0, 1] };

  function key(event) {
    const name = event.key.length === 1 ? event.key.toLowerCase() : event.key;
    const command = event.ctrlKey || event.metaKey;
    if (event.altKey || (command && name !== "s" && name !== "z")) return;
    const onButton = event.target instanceof HTMLElement && event.target.matches("button, summary, input");
    if (onButton && (name === " " || name === "Enter")) return;
    const current = state.points[point].name, goal = marks[photo].get(current) ?? predicted.pixels.get(current);
    const acts = {
      n: () => show(photo, step(point, 1, state.points.length), true),
      p: () => show(photo, step(point, -1, state.points.length), true),
      " ": nextOpen,
      PageDown: () => show(step(photo, 1, state.photos.length), point, true),
      PageUp: () => show(step(photo, -1, state.photos.length), point, true),
      Enter: () => (predicted.pixels.get(current) ? mark(predicted.pixels.get(current), $("snap").checked) : say("No position is predicted yet.")),
      Delete: remove,
      Backspace: remove,
      u: undo,
      z: command ? undo : undefined,
      t: () => { $("snap").checked = !$("snap").checked; say($("snap").checked ? "Marks snap to targets and corners." : "Marks stay where you click."); },
      "+": () => zoom(1.5),
      "=": () => zoom(1.5),
      "-": () => zoom(1 / 1.5),
      0: () => { looks[photo] = whole(photo, look().turn); draw(); },
      1: () => { look().scale = 1; draw(); },
      g: () => (goal ? goTo(goal, 4) : say("This point is neither marked nor predicted here.")),
      r: () => { looks[photo] = whole(photo, (look().turn + 1) % 4); draw(); },
    };
    if (command && name === "s") acts.s = save;
    else if (PANS[name]) acts[name] = () => pan(PANS[name][0] * 60, PANS[name][1] * 60);
    if (ARROWS[name]) {
      const by = event.shiftKey ? 1 : 0.1;
      acts[name] = () => nudge(ARROWS[name][0] * by, ARROWS[name][1] * by);
    }
    if (!Object.hasOwn(acts, name) || !acts[name]) return;
    event.preventDefault();
    acts[name]();
  }

  // --- Start ------------------------------------------------------------------------------------

  async function start() {
    try {
      state = await (await fetch("state")).json();
    } catch {
      gone();
      return;
    }
    marks = state.photos.map(() => new Map());
    for (const [number, name, u, v] of state.marks) marks[number].set(name, [u, v]);
    buildLists();
    listen();
    const [, a, b] = /^#(\d+)\/(\d+)$/.exec(location.hash) ?? [];
    photo = a < state.photos.length ? Number(a) : 0;
    point = b < state.points.length ? Number(b) : 0;
    show(photo, point);
    await refresh(photo).catch(gone);
    lists();
    draw();
    view.focus();
    say(state.focal
      ? "Click the point in the photo. After four marks in a photo the others are predicted."
      : "Click the point in the photo. The photos do not state their focal length: start with --focal-px to have points predicted.");
  }

  start();
})();
