"""A method for sinsjax: attitude from the averaged force and rate of a base at rest."""
