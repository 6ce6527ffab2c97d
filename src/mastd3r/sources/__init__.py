"""Where frames come from: video files, image folders, TUM-layout folders, a synthetic room."""
