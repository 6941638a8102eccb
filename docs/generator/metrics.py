"""The page of the metrics of services and exporters."""

from __future__ import annotations

from nedbus.monitoring.metrics import METRICS, build_info

from .markdown import cell, code, page, table


def metrics_page() -> str:
    """Return the page of all metrics: name, kind, labels and help text."""
    kinds = {
        name: (kind(name, "-").type, labels, text) for name, (kind, labels, text) in METRICS.items()
    }
    build = build_info("")
    kinds[f"{build.name}_info"] = (build.type, [*build.samples[0].labels], build.documentation)
    rows = [
        [code(name + "_total" * (kind == "counter")), kind, code(", ".join(labels)), cell(text)]
        for name, (kind, labels, text) in kinds.items()
    ]
    return page(
        "Metrics",
        "A service with `--http` exposes its metrics at `/metrics`, and `nedbus export` those of a reader; "
        "dashboards and alerts: [Operations](../operate.md).",
        "`process_*` are the standard metrics of Prometheus clients.",
        table(["metric", "kind", "labels", "meaning"], rows),
    )
