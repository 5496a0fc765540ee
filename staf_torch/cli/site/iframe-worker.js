// The search of the site runs in a worker. A page that is opened from a folder may start none: there the same
// script runs in a hidden frame. (The theme would load such a file from a server.)
class FrameWorker extends EventTarget {
  constructor(url) {
    super()
    this.frame = document.createElement("iframe")
    this.frame.hidden = true
    document.body.appendChild(this.frame)
    window.addEventListener("message", (event) => {
      if (event.source !== this.frame.contentWindow) return
      this.dispatchEvent(new MessageEvent("message", { data: event.data }))
    })
    const inside = this.frame.contentWindow
    inside.document.open()
    inside.document.write(
      "<!doctype html><body><script>postMessage = (data) => parent.postMessage(data, '*')</script>" +
        `<script src="${new URL(url, location.href)}"></script></body>`
    )
    inside.document.close()
    this.ready = new Promise((resolve) => {
      const look = () => (inside.document.readyState === "complete" ? resolve() : setTimeout(look, 20))
      look()
    })
  }
  postMessage(data) {
    this.ready.then(() => {
      this.frame.contentWindow.dispatchEvent(new MessageEvent("message", { data }))
    })
  }
  terminate() {
    this.frame.remove()
  }
}
if (location.protocol === "file:") window.Worker = FrameWorker

// Which versions lie beside this one: a list in the header of every page, also without a server.
document.addEventListener("DOMContentLoaded", () => {
  const versions = window.__versions || []
  const title = document.querySelector(".md-header__topic .md-ellipsis")
  if (!title || versions.length === 0) return
  const list = document.createElement("select")
  list.className = "versions"
  list.setAttribute("aria-label", "version")
  const root = new URL("../", new URL(JSON.parse(document.querySelector("#__config").textContent).base + "/", location.href))
  for (const version of versions) {
    const here = location.href.startsWith(new URL(version + "/", root).href)
    list.add(new Option(version, version, here, here))
  }
  list.addEventListener("change", () => (location.href = new URL(list.value + "/index.html", root)))
  title.append(list)
})
