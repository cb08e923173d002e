"""Questions of a lab, one of each kind, with their texts and answers to them."""

from __future__ import annotations

from typing import Any

from physion.experiment.study.settings import ComprehensionQuestion, Question

OWN_QUESTIONS = (
    Question("strategy", "text"),
    Question("games", "choice", required=True, options=("never", "often")),
    Question("devices", "choices", options=("phone", "console", "computer")),
    Question("confidence", "scale", required=True, steps=5),
)
OWN_TEXTS = """
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
    "devices": ["console", "phone"],
    "confidence": 4,
}

COMPREHENSION = (
    ComprehensionQuestion("task", ("fall", "touch"), "touch"),
    ComprehensionQuestion("colour", ("red", "green", "yellow"), "red"),
)
COMPREHENSION_TEXTS = """
[comprehension_question.task]
text = "What do you predict?"
[comprehension_question.task.options]
fall = "What falls"
touch = "What touches"
[comprehension_question.colour]
text = "Which object moves?"
[comprehension_question.colour.options]
red = "The red one"
green = "The green one"
yellow = "The yellow one"
"""
RIGHT: dict[str, Any] = {"task": "touch", "colour": "red"}
WRONG: dict[str, Any] = {"task": "touch", "colour": "green"}
