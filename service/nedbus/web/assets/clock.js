// Tick labels of a time axis: UTC, or seconds; the middle label names the clock.
const seconds = tick / 1000 + start
const isFine = ticks.length > 1 && ticks[1] - ticks[0] < 1000
const text = clock == "UTC" ? new Date(seconds * 1000).toISOString().slice(11, isFine ? 21 : 19) : seconds.toFixed(isFine ? 1 : 0)
return tick == ticks[ticks.length >> 1] ? `${text} ${clock}` : text
