// Body of a Bokeh callback with the arguments `message`, `map` and `search`.
// Sends clicks, keys and the size of the map to the server as the value of `message`, a hidden input.
if (window.nedbusActions) return
window.nedbusActions = true
const send = (action, value = "") => {
  if (/^(focus|vehicle|event)/.test(action)) map.reset.emit()
  message.value = JSON.stringify([action, value, Date.now()])
}
const buttonOf = event => event.composedPath().find(each => each.dataset?.do)
const press = button => {
  if (button.dataset.do != "theme") return send(button.dataset.do, button.dataset.with)
  const query = new URLSearchParams(location.search)
  query.set("theme", query.get("theme") == "light" ? "dark" : "light")
  location.search = query
}

let pressed = null  // not "click": it is lost if an update replaces the element between pointerdown and pointerup
document.addEventListener("pointerdown", event => {
  pressed = event.button == 0 ? {button: buttonOf(event), x: event.clientX, y: event.clientY} : null
})
document.addEventListener("pointercancel", () => { pressed = null })
document.addEventListener("pointerup", event => {
  if (pressed?.button && Math.hypot(event.clientX - pressed.x, event.clientY - pressed.y) < 12) press(pressed.button)
  pressed = null
})

const keys = {" ": "play", ArrowLeft: "left", ArrowRight: "right", n: "next", p: "previous", j: "down", k: "up",
  ArrowDown: "down", ArrowUp: "up", a: "focus:all", f: "focus:follow", z: "focus:vehicle", t: "trail", Escape: "now"}
document.addEventListener("keydown", event => {
  const target = event.composedPath()[0], button = buttonOf(event)
  const isPress = event.key == "Enter" || (event.key == " " && target.dataset?.do)
  const isOwn = ["INPUT", "SELECT"].includes(target.tagName) || target.getAttribute?.("role") == "slider"
    || (target.tagName == "BUTTON" && [" ", "Enter"].includes(event.key) && !target.dataset.do)
  if (isOwn || event.ctrlKey || event.metaKey || event.altKey) return
  const action = keys[event.key]
  if (isPress && button) press(button)
  else if (event.key == "/") search.view?.focus?.()
  else if (action) send(event.shiftKey && /^Arrow[LR]/.test(event.key) ? action.toUpperCase() : action)
  else return
  event.preventDefault()
})

const measure = () => { if (map.inner_width > 50) send("size", `${map.inner_width}x${map.inner_height}`) }
setTimeout(measure, 1500)
window.addEventListener("resize", () => setTimeout(measure, 500))
