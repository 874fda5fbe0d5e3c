"""The metrics of a run, as Prometheus reads them."""

import urllib.request

from prometheus_client.parser import text_string_to_metric_families


def scrape(place: str) -> dict[tuple[str, ...], float]:
    """Values by name and labels other than the job, which is the same in all."""
    with urllib.request.urlopen(f"http://{place}/metrics", timeout=5) as answer:
        families = list(text_string_to_metric_families(answer.read().decode()))
    samples = [sample for family in families for sample in family.samples]
    assert len({sample.labels["job"] for sample in samples}) == 1
    return {
        (one.name, *(value for label, value in sorted(one.labels.items()) if label != "job")): one.value
        for one in samples
    }
