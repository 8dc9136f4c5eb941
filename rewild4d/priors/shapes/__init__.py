"""What shapes animals have: a Gaussian over the template's proportions and relief, learned from random animals."""
