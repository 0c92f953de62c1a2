//! Files that are given to us: read when they are plain files, and only up to a size.

use std::fs::{File, OpenOptions};
use std::io::{self, ErrorKind, Read};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use rustix::fs::OFlags;

/// Opens a plain file. A pipe is refused instead of waited for, a folder and a device too.
///
/// # Errors
/// When it cannot be opened, or is no plain file.
pub fn open_plain(path: &Path) -> io::Result<File> {
    // A pipe nobody writes to would block in `open` otherwise.
    let file = OpenOptions::new().read(true).custom_flags(OFlags::NONBLOCK.bits() as i32).open(path)?;
    match file.metadata()?.is_file() {
        true => Ok(file),
        false => Err(io::Error::new(ErrorKind::InvalidInput, "it is no plain file")),
    }
}

/// The text of a plain file of at most `limit` bytes, or of a pipe that the shell or the caller has opened for us, such as `/dev/stdin`.
///
/// # Errors
/// As [`read_text`].
pub fn read_answerable(path: &Path, limit: u64) -> io::Result<String> {
    let opened = ["/dev/stdin", "/dev/fd/", "/proc/self/fd/"].iter().any(|place| path.starts_with(place));
    if opened { read_from(File::open(path)?, limit) } else { read_text(path, limit) }
}

/// The text of a plain file of at most `limit` bytes.
///
/// # Errors
/// When it cannot be read, is no plain file, is larger, or is not UTF-8.
pub fn read_text(path: &Path, limit: u64) -> io::Result<String> {
    read_from(open_plain(path)?, limit)
}

/// The content of a plain file of at most `limit` bytes.
///
/// # Errors
/// When it cannot be read, is no plain file, or is larger.
pub fn read_bytes(path: &Path, limit: u64) -> io::Result<Vec<u8>> {
    let mut bytes = Vec::new();
    open_plain(path)?.take(limit + 1).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > limit { Err(too_large(limit)) } else { Ok(bytes) }
}

fn read_from(file: File, limit: u64) -> io::Result<String> {
    let mut text = String::new();
    file.take(limit + 1).read_to_string(&mut text)?;
    if text.len() as u64 > limit {
        return Err(too_large(limit));
    }
    Ok(text)
}

fn too_large(limit: u64) -> io::Error {
    io::Error::new(ErrorKind::FileTooLarge, format!("it is larger than {limit} bytes"))
}
