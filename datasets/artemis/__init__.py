"""Read, check and write folders in the Artemis / Dynamic Furry Animals format."""
