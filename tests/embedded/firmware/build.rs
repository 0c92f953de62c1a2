//! Puts the memory map where the linker looks for it.

use std::env::var_os;
use std::path::PathBuf;

fn main() -> std::io::Result<()> {
    let out = PathBuf::from(var_os("OUT_DIR").unwrap_or_default());
    std::fs::copy("memory.x", out.join("memory.x"))?;
    println!("cargo::rustc-link-search={}", out.display());
    println!("cargo::rerun-if-changed=memory.x");
    Ok(())
}
