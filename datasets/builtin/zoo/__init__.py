"""Random animals by seed: body plans, coats and motions of animals to develop on and of animals never tuned on."""
