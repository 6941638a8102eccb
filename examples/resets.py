"""Plot a flight twice: as its estimator reported it, with all resets, and as a track without jumps."""

import sys

import matplotlib.pyplot as plt

import nedbus

flight, picture = sys.argv[1:]
tracker = nedbus.ResetTracker()
messages = [nedbus.to_message(element) for element in nedbus.read(flight)]
tracks = [tracker.add(message) for message in messages]

figure, axes = plt.subplots(figsize=(8, 6), layout="constrained")
axes.plot(
    [message.y for message in messages],
    [message.x for message in messages],
    ":",
    label="x, y of the messages",
)
axes.plot(
    [track.y for track in tracks],
    [track.x for track in tracks],
    label="without the jumps of resets",
)
north = east = 0.0  # sum of all jumps
for message, track in zip(messages, tracks, strict=True):
    before, (north, east) = (north, east), (message.x - track.x, message.y - track.y)
    if "xy" in track.reset:
        axes.plot(message.y, message.x, "rx")
        print(
            f"{message.timestamp / 1e6:.2f} s: xy reset by {north - before[0]:.2f}, {east - before[1]:.2f} m"
        )
axes.set(
    xlabel="east [m]",
    ylabel="north [m]",
    aspect="equal",
    title="crosses: the position after a reset of xy",
)
axes.legend()
figure.savefig(picture)
