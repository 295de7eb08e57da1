"""What is measured through judges and by classical trackers: lanes, cuboids, Frechet distances, motion (docs/judges.md). No torch here."""
