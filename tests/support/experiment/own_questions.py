"""Questions of a lab, one of each kind, with their words and answers to them."""

from __future__ import annotations

from typing import Any

from physion.experiment.study.questions import Question

OWN_QUESTIONS = (
    Question("strategy", "text"),
    Question("games", "choice", required=True, options=("never", "often")),
    Question("devices", "choices", options=("phone", "console", "computer")),
    Question("confidence", "scale", required=True, steps=5),
)
OWN_WORDS = """
[question.strategy]
text = "Did you follow a strategy?"
[question.games]
text = "How often do you play computer games?"
[question.games.options]
never = "Never"
often = "Often"
[question.devices]
text = "On which devices?"
[question.devices.options]
phone = "Telephone"
console = "Console"
computer = "Computer"
[question.confidence]
text = "How sure were you?"
low = "Not at all"
high = "Very"
"""
OWN_ANSWERS: dict[str, Any] = {
    "strategy": "=I looked; closely",
    "games": "often",
    "devices": ["computer", "phone"],
    "confidence": 4,
}
