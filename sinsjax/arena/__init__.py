"""Programs outside sinsjax on the draws of a study: data for them, and their results compared."""
