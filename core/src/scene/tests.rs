mod colmap;
mod fixture;
mod json;
