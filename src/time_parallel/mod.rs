//! Temporal partition, upsampling, detail recovery [Liang and Lin 2018]. Nothing is here yet.
