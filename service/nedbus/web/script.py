"""What Bokeh does not do, in JavaScript: clicks on text, keys, the address of the page, and a server that is away."""

from __future__ import annotations

from typing import Final

ACTIONS: Final = """
if (window.nedbusActions) return
window.nedbusActions = true
const say = (action, value) => { said.value = JSON.stringify([action, value ?? "", Date.now()]) }
const reset = action => { if (/^(focus|vehicle|event)/.test(action)) map.reset.emit() }
const act = event => {
  const part = event.composedPath().find(each => each.dataset?.do)
  if (!part) return false
  if (part.dataset.do == "theme") {
    const asked = new URLSearchParams(location.search)
    asked.set("theme", asked.get("theme") == "light" ? "dark" : "light")
    location.search = asked
    return true
  }
  reset(part.dataset.do); say(part.dataset.do, part.dataset.with)
  return true
}
let pressed = null  // what is under the pointer may be written anew while it is down
document.addEventListener("pointerdown", event => {
  const part = event.button == 0 && event.composedPath().find(each => each.dataset?.do)
  pressed = part ? {path: [part], x: event.clientX, y: event.clientY} : null
})
document.addEventListener("pointercancel", () => { pressed = null })
document.addEventListener("pointerup", event => {
  const held = pressed
  pressed = null
  if (held && Math.hypot(event.clientX - held.x, event.clientY - held.y) < 12) act({composedPath: () => held.path})
})
const measure = () => { if (map.inner_width > 50) say("size", map.inner_width + "x" + map.inner_height) }
setTimeout(measure, 1500)
window.addEventListener("resize", () => setTimeout(measure, 500))
const keys = {" ": "play", ArrowLeft: "left", ArrowRight: "right", n: "next", p: "previous", j: "down", k: "up",
  ArrowDown: "down", ArrowUp: "up", a: "focus:all", f: "focus:follow", z: "focus:vehicle", t: "trail", Escape: "now"}
document.addEventListener("keydown", event => {
  const target = event.composedPath()[0]
  const isOwn = ["INPUT", "SELECT"].includes(target.tagName) || target.getAttribute?.("role") == "slider"
  if (isOwn || event.ctrlKey || event.metaKey || event.altKey) return
  if (target.tagName == "BUTTON" && (event.key == " " || event.key == "Enter")) return
  if (event.key == "Enter" || (event.key == " " && target.dataset?.do)) {
    if (act(event)) event.preventDefault()
    return
  }
  if (event.key == "/") { search.view?.focus?.(); event.preventDefault(); return }
  const action = keys[event.key]
  if (!action) return
  reset(action)
  say(event.shiftKey && event.key.startsWith("Arrow") ? action.toUpperCase() : action)
  event.preventDefault()
})
"""
"""Tell the viewer which part of a text was clicked, which key was pressed, and how large the map is."""

ADDRESS: Final = 'history.replaceState(null, "", cb_obj.value)'
"""Keep the address of the page."""

DRAWN: Final = "requestAnimationFrame(() => { drawn.value = cb_obj.value })"
"""Tell when a picture was drawn."""

CLOCK: Final = """
const seconds = tick / 1000 + start
if (start || tick > 1e11) {
  const text = new Date(seconds * 1000).toISOString()
  return text.slice(11, ticks.length > 1 && ticks[1] - ticks[0] < 1000 ? 21 : 19)
}
return Math.floor(seconds / 60) + ":" + String(Math.round((seconds % 60) * 10) / 10).padStart(2, "0")
"""
"""Write the ticks of a time axis: UTC where it is known, else minutes and seconds since the start."""

LOST: Final = """
if (window.nedbusLost) return
window.nedbusLost = document.createElement("div")
window.nedbusLost.textContent = "nedbus web does not answer since " + new Date().toLocaleTimeString() + ": waiting"
window.nedbusLost.style = "position:fixed;top:0;width:100%;padding:9px;background:#b3261e;color:#fff;font:15px sans"
document.body.append(window.nedbusLost)
setInterval(() => fetch("/healthz").then(answer => answer.ok && location.reload()).catch(() => {}), 1000)
"""
"""Say that the server does not answer, and begin anew when it does."""
