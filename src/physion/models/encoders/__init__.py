"""Models with an image or video encoder of timm or transformers, frozen or fine-tuned.

- `encoder`: image encoders with dynamics on their features (pVGG, pDeIT, ...).
- `video`: video encoders without dynamics.
- `weights`: networks of timm, and where their weights come from.
"""
