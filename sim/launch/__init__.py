"""A whole team as processes: started, watched, ordered about, ended."""
