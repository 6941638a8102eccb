// Tick labels of a time axis: UTC if the start of the recording is known, else minutes and seconds since it.
const seconds = tick / 1000 + start
if (start || tick > 1e11) {
  const text = new Date(seconds * 1000).toISOString()
  return text.slice(11, ticks.length > 1 && ticks[1] - ticks[0] < 1000 ? 21 : 19)
}
return `${Math.floor(seconds / 60)}:${String(Math.round((seconds % 60) * 10) / 10).padStart(2, "0")}`
