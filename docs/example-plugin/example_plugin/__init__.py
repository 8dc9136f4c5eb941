"""A method, a data set, a metric and a protocol for rewild4d, each as short as it can be."""
