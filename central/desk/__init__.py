"""The operator's desk: reports, pictures, pages and checks of a team."""
