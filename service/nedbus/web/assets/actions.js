// Body of a Bokeh callback with the arguments `message`, `map` and `search`.
// Sends clicks, keys and the size of the map to the server as the value of `message`, a hidden input.
if (window.nedbusActions) return
window.nedbusActions = true
const send = (action, value = "") => {
  if (/^(focus|vehicle|event)/.test(action)) map.reset.emit()
  message.value = JSON.stringify([action, value, Date.now()])
}
const partOf = event => event.composedPath().find(each => each.dataset?.do)
const act = part => {
  if (part.dataset.do != "theme") return send(part.dataset.do, part.dataset.with)
  const query = new URLSearchParams(location.search)
  query.set("theme", query.get("theme") == "light" ? "dark" : "light")
  location.search = query
}

let pressed = null  // "click" events would be lost if an update replaces the element between pointerdown and pointerup
document.addEventListener("pointerdown", event => {
  pressed = event.button == 0 ? {part: partOf(event), x: event.clientX, y: event.clientY} : null
})
document.addEventListener("pointercancel", () => { pressed = null })
document.addEventListener("pointerup", event => {
  if (pressed?.part && Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) < 12) act(pressed.part)
  pressed = null
})

const keys = {" ": "play", ArrowLeft: "left", ArrowRight: "right", n: "next", p: "previous", j: "down", k: "up",
  ArrowDown: "down", ArrowUp: "up", a: "focus:all", f: "focus:follow", z: "focus:vehicle", t: "trail", Escape: "now"}
document.addEventListener("keydown", event => {
  const target = event.composedPath()[0], part = partOf(event)
  const isPress = event.key == "Enter" || (event.key == " " && target.dataset?.do)
  const isOwn = ["INPUT", "SELECT"].includes(target.tagName) || target.getAttribute?.("role") == "slider"
    || (target.tagName == "BUTTON" && [" ", "Enter"].includes(event.key) && !target.dataset.do)
  if (isOwn || event.ctrlKey || event.metaKey || event.altKey) return
  const action = keys[event.key]
  if (isPress && part) act(part)
  else if (event.key == "/") search.view?.focus?.()
  else if (action) send(event.shiftKey && /^Arrow[LR]/.test(event.key) ? action.toUpperCase() : action)
  else return
  event.preventDefault()
})

const measure = () => { if (map.inner_width > 50) send("size", `${map.inner_width}x${map.inner_height}`) }
setTimeout(measure, 1500)
window.addEventListener("resize", () => setTimeout(measure, 500))
