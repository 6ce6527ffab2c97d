"""The stages of a frame while the video is read, and what happens when one of them fails."""
