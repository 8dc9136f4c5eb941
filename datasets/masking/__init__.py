"""Read masks, and make them where there are none."""

DETECTOR = "IDEA-Research/grounding-dino-tiny"
SEGMENTER = "facebook/sam2.1-hiera-small"
"""Models of Hugging Face that `grounded_sam` uses where no others are named."""
