// The server is away: say so, and load the page again when it answers.
if (window.nedbusLost) return
const bar = window.nedbusLost = document.createElement("div")
bar.textContent = `nedbus web does not answer since ${new Date().toLocaleTimeString()}: waiting`
bar.style = "position:fixed;top:0;width:100%;padding:9px;background:#b3261e;color:#fff;font:15px sans"
document.body.append(bar)
setInterval(() => fetch("/healthz").then(answer => answer.ok && location.reload()).catch(() => {}), 1000)
