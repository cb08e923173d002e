"""OP3: object-centric perception, prediction and planning (Veerapaneni et al. 2020)."""
