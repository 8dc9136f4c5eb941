"""The networks that metrics read images and videos with, in plain torch, as functions of their weights."""
