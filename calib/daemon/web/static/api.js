// Requests to the daemon: with a token if needed, errors as one line, and a stream that reconnects on its own.

const KEY = "armlink-token";
let asking = null;

export const token = () => localStorage.getItem(KEY);
export const forgetToken = () => localStorage.removeItem(KEY);

function askToken(wrong) {
  asking ??= new Promise((resolve) => {
    const dialog = document.getElementById("ask-token");
    const field = document.getElementById("token");
    document.getElementById("token-error").textContent = wrong ? "This token is wrong." : "";
    field.value = "";
    dialog.addEventListener("cancel", (event) => event.preventDefault());
    dialog.addEventListener("close", () => {
      localStorage.setItem(KEY, field.value.trim());
      asking = null;
      resolve();
    }, { once: true });
    dialog.showModal();
  });
  return asking;
}

async function request(path, options = {}) {
  for (;;) {
    const sent = token();
    const headers = { ...options.headers, ...(sent ? { Authorization: `Bearer ${sent}` } : {}) };
    const answer = await fetch(path, { ...options, headers, cache: "no-store" });
    if (answer.status !== 401) return answer;
    if (sent === token()) await askToken(sent !== null); // else another request has asked for it meanwhile
  }
}

async function answerOf(answer) {
  if (answer.ok) return answer.json();
  const body = await answer.json().catch(() => ({}));
  throw new Error(body.error || `${answer.status} ${answer.statusText}`);
}

export const get = async (path) => answerOf(await request(path));

export const post = async (path, body) =>
  answerOf(await request(path, { method: "POST", headers: { "Content-Type": "application/json" }, body: JSON.stringify(body) }));

export async function blob(path) {
  const answer = await request(path);
  return answer.ok ? answer.blob() : answerOf(answer);
}

// Calls on.joints, on.event, on.open and on.lost until the page is closed. EventSource cannot send a token, hence fetch.
export async function stream(on, after) {
  let last = after;
  const silence = 8000;
  for (;;) {
    const abort = new AbortController();
    let timer = setTimeout(() => abort.abort(), silence);
    try {
      const answer = await request("/api/stream", { headers: { "Last-Event-ID": String(last) }, signal: abort.signal });
      if (!answer.ok) await answerOf(answer);
      on.open();
      const reader = answer.body.pipeThrough(new TextDecoderStream()).getReader();
      let rest = "";
      for (;;) {
        const { done, value } = await reader.read();
        if (done) break;
        clearTimeout(timer);
        timer = setTimeout(() => abort.abort(), silence);
        const blocks = (rest + value).split("\n\n");
        rest = blocks.pop();
        for (const block of blocks) {
          const fields = Object.fromEntries(block.split("\n").map((line) => [line.slice(0, line.indexOf(":")), line.slice(line.indexOf(":") + 2)]));
          if (fields.id) last = Number(fields.id);
          if (fields.data) on[fields.event]?.(JSON.parse(fields.data));
        }
      }
      on.lost("the daemon closed the connection");
    } catch (error) {
      on.lost(abort.signal.aborted ? "the daemon does not respond" : error.message);
    }
    clearTimeout(timer);
    await new Promise((wake) => setTimeout(wake, 1000));
  }
}
