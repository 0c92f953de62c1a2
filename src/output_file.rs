//! Files that we write. In a folder of ours, whatever lies in their place is replaced and never followed; where the user has named a
//! file, it is opened as it is, but a pipe that nobody reads is not waited for.

use std::fs::{self, File, OpenOptions};
use std::io::{self, ErrorKind, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use rustix::fs::OFlags;
use rustix::io::Errno;

/// A new file in a folder of ours. A file, link or pipe of that name goes first: what a link, hard or symbolic, leads to stays as it is.
///
/// # Errors
/// When what is there cannot be removed, a folder for instance, or the file cannot be made.
pub fn create(path: &Path) -> io::Result<File> {
    make_way(path)?;
    OpenOptions::new().read(true).write(true).create_new(true).open(path)
}

/// Writes a file in a folder of ours: [`create`].
///
/// # Errors
/// As [`create`], and when it cannot be written.
pub fn write(path: &Path, content: impl AsRef<[u8]>) -> io::Result<()> {
    create(path)?.write_all(content.as_ref())
}

/// A folder in a folder of ours: the one that is there, but never what a link leads to.
///
/// # Errors
/// When it cannot be made.
pub fn folder(path: &Path) -> io::Result<()> {
    match fs::symlink_metadata(path) {
        Ok(there) if there.is_dir() => return Ok(()),
        Ok(_) => make_way(path)?,
        Err(_) => {}
    }
    fs::create_dir_all(path)
}

/// Writes a file that the user has named, a device or an open pipe too.
///
/// # Errors
/// When it cannot be written, or is a pipe that nobody reads.
pub fn write_named(path: &Path, content: impl AsRef<[u8]>) -> io::Result<()> {
    let nonblocking = OFlags::NONBLOCK.bits() as i32;
    let opened =
        OpenOptions::new().write(true).create(true).truncate(true).custom_flags(nonblocking).open(path);
    let mut file = opened.map_err(|error| match error.raw_os_error() {
        Some(code) if code == Errno::NXIO.raw_os_error() => {
            io::Error::new(ErrorKind::InvalidInput, "it is a pipe that nobody reads")
        }
        _ => error,
    })?;
    // Who reads slowly is waited for.
    rustix::fs::fcntl_setfl(&file, OFlags::empty())?;
    file.write_all(content.as_ref())
}

fn make_way(path: &Path) -> io::Result<()> {
    match fs::remove_file(path) {
        Err(error) if error.kind() != ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}
