"""Models with an image or video encoder of timm or transformers, frozen or fine-tuned.

- `settings`: settings of encoder and dynamics, and the sizes of each family (pVGG, pDeIT, ...).
- `dynamics`: networks that predict the next feature.
- `encoder_model`: what all models with an image encoder have.
- `frozen`, `fine_tuned`: the encoder stays as it is, or learns with the dynamics.
- `trained`: weights of a training in place of the initial weights.
- `build`: the registered models.
- `video`: video encoders without dynamics.
"""
