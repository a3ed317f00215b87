// Browsers run no workers on pages opened from disk. The search then runs in a hidden frame instead.
if (location.protocol === "file:") {
  class IFrameWorker extends EventTarget {
    constructor(url) {
      super();
      const frame = document.createElement("iframe");
      frame.hidden = true;
      document.body.appendChild(frame);
      this.frame = frame;
      this.inside = frame.contentWindow;
      window.addEventListener("message", (event) => {
        if (event.source !== this.inside) return;
        const message = new MessageEvent("message", { data: event.data });
        this.dispatchEvent(message);
        if (this.onmessage) this.onmessage(message);
      });
      const page = this.inside.document;
      this.inside.postMessage = (data) => window.dispatchEvent(
        new MessageEvent("message", { data, source: this.inside }));
      this.inside.importScripts = (...urls) => urls.reduce(
        (before, next) => before.then(() => load(page, next)), Promise.resolve());
      this.ready = load(page, url);
    }

    postMessage(data) {
      this.ready.then(() => this.inside.dispatchEvent(new MessageEvent("message", { data })));
    }

    terminate() {
      this.frame.remove();
    }
  }

  const load = (page, url) => new Promise((done, failed) => {
    const script = page.createElement("script");
    script.src = new URL(url, location.href);
    script.onload = done;
    script.onerror = failed;
    page.head.appendChild(script);
  });

  window.IFrameWorker = IFrameWorker;
  window.Worker = IFrameWorker;
}
