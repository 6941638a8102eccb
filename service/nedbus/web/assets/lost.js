// Connection lost: show a bar, and reload the page once the server responds again.
if (window.nedbusLost) return
const bar = window.nedbusLost = document.createElement("div")
bar.textContent = `nedbus web has not responded since ${new Date().toLocaleTimeString()}, reconnecting`
bar.style = "position:fixed;top:0;width:100%;padding:9px;background:#b3261e;color:#fff;font:15px sans"
document.body.append(bar)
setInterval(() => fetch("/healthz").then(response => response.ok && location.reload()).catch(() => {}), 1000)
