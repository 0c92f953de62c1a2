//! A server for one page and its stream, on loopback: few connections, small requests, a time for everything.
//!
//! A connection costs a thread only once the whole head of its request is there. Those that say nothing, or say it slowly, wait in a list
//! until their time is over or newer ones push them out. A page that does not read is closed; of too many pages the oldest are.
//!
//! | request | answer |
//! |---|---|
//! | `GET /` | the page |
//! | `GET /stream`, upgraded to a websocket | all rows so far, then each new one; hears wishes of [`crate::steering`] as text |

use std::collections::VecDeque;
use std::io::{ErrorKind, Write};
use std::net::{Ipv4Addr, Shutdown, TcpListener, TcpStream};
use std::sync::atomic::{AtomicBool, AtomicU64, AtomicUsize, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::thread::{JoinHandle, sleep};
use std::time::{Duration, Instant};

use tungstenite::handshake::server::{ErrorResponse, Request, Response};
use tungstenite::protocol::WebSocketConfig;
use tungstenite::{Error, Message, WebSocket};

use crate::steering::Wish;
use crate::supervisor::PlantPipe;
use crate::verdict::Failure;
use crate::view::send_line;

/// Most connections at a time whose request is there.
const MOST_CONNECTIONS: usize = 16;
/// Most pages of these; the newest stay. The rest is room for requests.
const MOST_STREAMS: u64 = 8;
/// Most connections that have not said what they want.
const MOST_HALF_OPEN: usize = 64;
/// Time for the head of a request.
const HEAD_PATIENCE: Duration = Duration::from_secs(1);
/// Bytes that may wait for a page that reads slowly.
const MOST_UNREAD: usize = 1 << 20;
/// Shortest time between two wishes of a page; a mouse makes some sixty a second.
const WISH_PAUSE: Duration = Duration::from_millis(4);
/// Most bytes of a request's head, and of a wish.
const MOST_HEAD: usize = 8192;
const MOST_WISH: usize = 256;
/// Rows kept for who comes later, the newest: 40 a second, so 25 minutes.
const MOST_ROWS: usize = 60_000;
/// Connections taken in a row, and the pause before more are taken: so much of a core a flood of them may cost.
const MOST_AT_ONCE: usize = 32;
const BREATH: Duration = Duration::from_millis(2);
/// Time between two looks for new rows while a connection is silent.
const LOOK: Duration = Duration::from_millis(15);
/// A reader that is slower than this is gone.
const PATIENCE: Duration = Duration::from_secs(3);

/// What the connections share.
#[derive(Debug)]
struct Shared {
    page: String,
    port: u16,
    rows: Mutex<Rows>,
    wish: Mutex<Wish>,
    pipe: PlantPipe,
    connections: AtomicUsize,
    /// Pages opened so far.
    streams: AtomicU64,
    opened: AtomicBool,
    ends: AtomicBool,
}

/// The newest rows.
#[derive(Debug, Default)]
struct Rows {
    kept: VecDeque<Arc<str>>,
    /// How many there were before these.
    before: usize,
}

impl Rows {
    fn push(&mut self, row: Arc<str>) {
        if self.kept.len() == MOST_ROWS {
            self.kept.pop_front();
            self.before += 1;
        }
        self.kept.push_back(row);
    }

    /// The row of this number, or the first one after it that is still there, and its number.
    fn from(&self, number: usize) -> Option<(usize, Arc<str>)> {
        let number = number.max(self.before);
        self.kept.get(number - self.before).map(|row| (number, row.clone()))
    }
}

/// The server.
#[derive(Debug)]
pub struct Server {
    shared: Arc<Shared>,
    acceptor: Mutex<Option<JoinHandle<()>>>,
}

impl Server {
    /// Begins to serve; port 0: a free one.
    ///
    /// # Errors
    /// [`Failure::Input`] when the port is taken.
    pub fn start(port: u16, page: String, pipe: PlantPipe) -> Result<Self, Failure> {
        let cannot = |error: &dyn std::fmt::Display| Failure::Input(format!("--port {port}: {error}"));
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port)).map_err(|error| cannot(&error))?;
        listener.set_nonblocking(true).map_err(|error| cannot(&error))?;
        let shared = Arc::new(Shared {
            page,
            port: listener.local_addr().map_err(|error| cannot(&error))?.port(),
            rows: Mutex::default(),
            wish: Mutex::new(Wish::none()),
            pipe,
            connections: AtomicUsize::new(0),
            streams: AtomicU64::new(0),
            opened: AtomicBool::new(false),
            ends: AtomicBool::new(false),
        });
        let for_acceptor = shared.clone();
        let acceptor = std::thread::Builder::new().spawn(move || accept_all(&listener, &for_acceptor));
        let acceptor = Mutex::new(Some(acceptor.map_err(Failure::fault)?));
        Ok(Self { shared, acceptor })
    }

    /// The port.
    pub fn port(&self) -> u16 {
        self.shared.port
    }

    /// Whether anybody has ever listened.
    pub fn has_been_opened(&self) -> bool {
        self.shared.opened.load(Ordering::Relaxed)
    }

    /// Sends a row to all who listen.
    pub fn publish(&self, row: String) {
        held(&self.shared.rows).push(row.into());
    }

    /// With what force a person pulls now (N).
    pub fn pull_w(&self) -> [f64; 3] {
        held(&self.shared.wish).pull.force_w
    }

    /// Waits until everybody has the last row, but not for long, and ends.
    pub fn finish(&self) {
        self.shared.ends.store(true, Ordering::Relaxed);
        let begin = Instant::now();
        while self.shared.connections.load(Ordering::Relaxed) > 0 && begin.elapsed() < PATIENCE {
            sleep(LOOK);
        }
        let acceptor = held(&self.acceptor).take();
        if let Some(acceptor) = acceptor {
            let _ = acceptor.join();
        }
    }
}

impl Drop for Server {
    fn drop(&mut self) {
        self.shared.ends.store(true, Ordering::Relaxed);
    }
}

fn held<T>(mutex: &Mutex<T>) -> MutexGuard<'_, T> {
    mutex.lock().unwrap_or_else(PoisonError::into_inner)
}

/// A connection that has not said what it wants.
struct HalfOpen {
    stream: TcpStream,
    since: Instant,
}

/// How far a request has come.
enum Head {
    /// All of it; it is still in the stream.
    Whole(String),
    /// More has to come.
    Part,
    /// No more will come, or it is too long.
    None,
}

fn accept_all(listener: &TcpListener, shared: &Arc<Shared>) {
    let mut half_open = VecDeque::with_capacity(MOST_HALF_OPEN + 1);
    while !shared.ends.load(Ordering::Relaxed) {
        let mut idle = true;
        for _ in 0..MOST_AT_ONCE {
            let Ok((stream, _)) = listener.accept() else { break };
            idle = false;
            if stream.set_nonblocking(true).is_ok() {
                half_open.push_back(HalfOpen { stream, since: Instant::now() });
            }
            if half_open.len() > MOST_HALF_OPEN {
                half_open.pop_front(); // dropped: closed
            }
        }
        for _ in 0..half_open.len() {
            let Some(HalfOpen { stream, since }) = half_open.pop_front() else { break };
            match peek_head(&stream) {
                Head::Whole(head) => begin_to_serve(stream, head, shared),
                Head::Part if since.elapsed() < HEAD_PATIENCE => {
                    half_open.push_back(HalfOpen { stream, since })
                }
                Head::Part | Head::None => {}
            }
        }
        sleep(if idle { LOOK } else { BREATH });
    }
}

/// Serves a request in a thread of its own, if there is room.
fn begin_to_serve(stream: TcpStream, head: String, shared: &Arc<Shared>) {
    if shared.connections.fetch_add(1, Ordering::Relaxed) >= MOST_CONNECTIONS {
        shared.connections.fetch_sub(1, Ordering::Relaxed);
        return;
    }
    let for_thread = shared.clone();
    let thread = std::thread::Builder::new().spawn(move || {
        // A connection that breaks is the reader's affair.
        let _ = serve(stream, &head, &for_thread);
        for_thread.connections.fetch_sub(1, Ordering::Relaxed);
    });
    if thread.is_err() {
        shared.connections.fetch_sub(1, Ordering::Relaxed);
    }
}

fn serve(stream: TcpStream, head: &str, shared: &Shared) -> Result<(), Error> {
    stream.set_nonblocking(false)?;
    stream.set_nodelay(true)?;
    stream.set_read_timeout(Some(PATIENCE))?;
    stream.set_write_timeout(Some(PATIENCE))?;
    if !names_us(header(head, "host"), shared.port) {
        return answer(stream, "403 Forbidden", "text/plain", "this page is for this machine only\n");
    }
    let path = head.split(' ').nth(1).unwrap_or_default();
    match (head.starts_with("GET "), path) {
        (true, "/") => answer(stream, "200 OK", "text/html; charset=utf-8", &shared.page),
        (true, "/stream") => listen_and_tell(stream, shared),
        _ => answer(stream, "404 Not Found", "text/plain", "nothing here\n"),
    }
}

/// Looks for the head of a request; leaves it in the stream and does not wait.
fn peek_head(stream: &TcpStream) -> Head {
    let mut bytes = [0; MOST_HEAD];
    let length = match stream.peek(&mut bytes) {
        Err(error) if [ErrorKind::WouldBlock, ErrorKind::Interrupted].contains(&error.kind()) => {
            return Head::Part;
        }
        Err(_) | Ok(0) => return Head::None,
        Ok(length) => length,
    };
    let head = String::from_utf8_lossy(&bytes[..length]);
    match head.contains("\r\n\r\n") {
        true => Head::Whole(head.into_owned()),
        false if length == MOST_HEAD => Head::None,
        false => Head::Part,
    }
}

fn header<'a>(head: &'a str, name: &str) -> &'a str {
    let mut lines = head.lines().skip(1).filter_map(|line| line.split_once(':'));
    lines.find(|(key, _)| key.eq_ignore_ascii_case(name)).map_or("", |(_, value)| value.trim())
}

/// Whether a host is this server by one of its own names, so that no foreign name that leads here is taken for it.
fn names_us(host: &str, port: u16) -> bool {
    ["127.0.0.1", "localhost"].iter().any(|name| host == format!("{name}:{port}"))
}

fn answer(mut stream: TcpStream, status: &str, kind: &str, body: &str) -> Result<(), Error> {
    // The request is read before the connection closes: closing over unread bytes would reset it.
    let mut request = vec![0; MOST_HEAD];
    let _ = std::io::Read::read(&mut stream, &mut request)?;
    let length = body.len();
    // In one piece: a page that is written bit by bit is sent bit by bit.
    let whole = format!(
        "HTTP/1.1 {status}\r\nContent-Type: {kind}\r\nContent-Length: {length}\r\nCache-Control: no-store\r\n\
         X-Content-Type-Options: nosniff\r\nX-Frame-Options: DENY\r\nConnection: close\r\n\r\n{body}"
    );
    stream.write_all(whole.as_bytes())?;
    stream.shutdown(Shutdown::Write)?;
    Ok(())
}

#[allow(clippy::result_large_err, reason = "the type is that of the websocket crate")]
fn listen_and_tell(stream: TcpStream, shared: &Shared) -> Result<(), Error> {
    let ours = |request: &Request, response: Response| {
        let origin =
            request.headers().get("origin").and_then(|origin| origin.to_str().ok()).unwrap_or_default();
        if origin.strip_prefix("http://").is_some_and(|host| names_us(host, shared.port)) {
            return Ok(response);
        }
        let mut refusal = ErrorResponse::new(Some("only the page itself may steer".to_owned()));
        *refusal.status_mut() = tungstenite::http::StatusCode::FORBIDDEN;
        Err(refusal)
    };
    let config = WebSocketConfig::default()
        .max_message_size(Some(MOST_WISH))
        .max_frame_size(Some(MOST_WISH))
        .write_buffer_size(0)
        .max_write_buffer_size(MOST_UNREAD);
    let Ok(mut socket) = tungstenite::accept_hdr_with_config(stream, ours, Some(config)) else {
        return Ok(());
    };
    shared.opened.store(true, Ordering::Relaxed);
    socket.get_ref().set_read_timeout(Some(LOOK))?;
    let outcome = converse(&mut socket, shared);
    // A page that is closed pulls at nothing any more.
    wish(shared, "release");
    outcome
}

fn converse(socket: &mut WebSocket<TcpStream>, shared: &Shared) -> Result<(), Error> {
    let number = shared.streams.fetch_add(1, Ordering::Relaxed);
    let mut told = 0;
    loop {
        let ends = shared.ends.load(Ordering::Relaxed);
        loop {
            // One at a time, and the next one when this one is out: what waits here is not read, and costs memory.
            let Some((number, row)) = held(&shared.rows).from(told) else { break };
            told = number + 1;
            tell(socket, &row)?;
        }
        let newer = shared.streams.load(Ordering::Relaxed).saturating_sub(number + 1);
        if ends || newer >= MOST_STREAMS {
            return say_goodbye(socket);
        }
        match socket.read() {
            Ok(Message::Text(line)) => {
                wish(shared, &line);
                sleep(WISH_PAUSE);
            }
            Ok(Message::Close(_)) => return Ok(()),
            Ok(_) => sleep(WISH_PAUSE),
            Err(error) => passing(Err(error))?,
        }
    }
}

/// Sends a row. Whoever has read nothing in the time a write may take is gone; a signal to the process is nobody's fault.
fn tell(socket: &mut WebSocket<TcpStream>, row: &str) -> Result<(), Error> {
    let mut told = socket.send(Message::text(row));
    while matches!(&told, Err(Error::Io(error)) if error.kind() == ErrorKind::Interrupted) {
        told = socket.flush();
    }
    told
}

/// Closes, and reads until the other end has closed too: what it has not read yet would be lost otherwise.
fn say_goodbye(socket: &mut WebSocket<TcpStream>) -> Result<(), Error> {
    passing(socket.close(None))?;
    let begin = Instant::now();
    while begin.elapsed() < PATIENCE {
        passing(socket.flush())?;
        passing(socket.read().map(drop))?;
    }
    Ok(())
}

/// Time that has run out, and a signal to the process (Ctrl-C), are no failures of a connection.
fn passing(outcome: Result<(), Error>) -> Result<(), Error> {
    const PASSING: [ErrorKind; 3] = [ErrorKind::WouldBlock, ErrorKind::TimedOut, ErrorKind::Interrupted];
    match outcome {
        Err(Error::Io(error)) if PASSING.contains(&error.kind()) => Ok(()),
        outcome => outcome,
    }
}

/// Passes a wish on if it is one.
fn wish(shared: &Shared, line: &str) {
    let line = line.lines().next().unwrap_or_default();
    let mut wish = held(&shared.wish);
    let before = *wish;
    // How many bodies there are, the plant knows.
    wish.hear(line, usize::MAX);
    if *wish != before {
        send_line(&shared.pipe, line);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::io::Read;

    fn ask(port: u16, request: &str) -> String {
        let mut stream = TcpStream::connect((Ipv4Addr::LOCALHOST, port)).unwrap();
        stream.write_all(request.as_bytes()).unwrap();
        let mut text = String::new();
        stream.read_to_string(&mut text).unwrap();
        text
    }

    #[test]
    fn the_page_is_served_to_this_machine_and_to_its_own_names() {
        let server = Server::start(0, "<p>page".to_owned(), PlantPipe::default()).unwrap();
        let port = server.port();
        let get = |path: &str, host: &str| ask(port, &format!("GET {path} HTTP/1.1\r\nHost: {host}\r\n\r\n"));
        let us = format!("127.0.0.1:{port}");
        assert!(get("/", &us).ends_with("\r\n\r\n<p>page"));
        assert!(get("/", &format!("localhost:{port}")).starts_with("HTTP/1.1 200 "));
        assert!(get("/secret", &us).starts_with("HTTP/1.1 404 "));
        assert!(get("/", "evil.example").starts_with("HTTP/1.1 403 "));
        assert!(get("/", &format!("127.0.0.1.evil.example:{port}")).starts_with("HTTP/1.1 403 "));
        assert!(ask(port, "POST / HTTP/1.1\r\n\r\n").starts_with("HTTP/1.1 403 "));
        assert!(!server.has_been_opened());
        server.finish();
    }

    #[test]
    fn those_who_say_nothing_or_say_it_slowly_do_not_keep_others_out() {
        let server = Server::start(0, "<p>page".to_owned(), PlantPipe::default()).unwrap();
        let port = server.port();
        let connect = || TcpStream::connect((Ipv4Addr::LOCALHOST, port)).unwrap();
        let us = format!("127.0.0.1:{port}");
        let page = || ask(port, &format!("GET / HTTP/1.1\r\nHost: {us}\r\n\r\n"));
        let mut half_open: Vec<TcpStream> = (0..200).map(|_| connect()).collect();
        for stream in &mut half_open[100..] {
            let _ = stream.write_all(format!("GET /stream HTTP/1.1\r\nHost: {us}\r\nX-").as_bytes());
        }
        for _ in 0..20 {
            let begin = Instant::now();
            assert!(page().ends_with("<p>page"));
            assert!(begin.elapsed() < HEAD_PATIENCE, "the page came after the others had given up");
            let mut newcomer = connect();
            let _ = newcomer.write_all(b"G");
            half_open.push(newcomer);
        }
        // Their time is over at some moment, however slowly they go on.
        let mut slow = connect();
        slow.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
        let begin = Instant::now();
        while slow.write_all(b"x").is_ok()
            && slow.read(&mut [0]).is_err_and(|e| e.kind() == ErrorKind::WouldBlock)
        {
            assert!(begin.elapsed() < 10 * HEAD_PATIENCE, "still open");
        }
        server.finish();
    }

    #[test]
    fn however_long_a_run_is_the_newest_rows_are_told_and_memory_is_bounded() {
        let mut rows = Rows::default();
        let (last, mut told) = (3 * MOST_ROWS, 0);
        for number in 0..=last {
            rows.push(number.to_string().into());
            let (number_told, row) = rows.from(told).unwrap();
            assert_eq!(
                (number_told, &*row),
                (number, &*number.to_string()),
                "a page that follows misses a row"
            );
            told = number_told + 1;
            assert_eq!(rows.from(told), None);
        }
        assert_eq!(rows.kept.len(), MOST_ROWS);
        // Who comes late gets what is kept.
        assert_eq!(rows.from(0).unwrap().0, last + 1 - MOST_ROWS);
    }

    #[test]
    #[allow(clippy::result_large_err, reason = "the type is that of the websocket crate")]
    fn only_the_page_itself_gets_the_stream() {
        let server = Server::start(0, String::new(), PlantPipe::default()).unwrap();
        let port = server.port();
        let connect = |origin: &str| {
            let stream = TcpStream::connect((Ipv4Addr::LOCALHOST, port)).unwrap();
            let request = Request::builder()
                .uri(format!("ws://127.0.0.1:{port}/stream"))
                .header("host", format!("127.0.0.1:{port}"))
                .header("origin", origin)
                .header("connection", "Upgrade")
                .header("upgrade", "websocket")
                .header("sec-websocket-version", "13")
                .header("sec-websocket-key", "dGhlIHNhbXBsZSBub25jZQ==");
            tungstenite::client(request.body(()).unwrap(), stream)
        };
        assert!(connect("http://evil.example").is_err());
        assert!(!server.has_been_opened());

        server.publish("1".to_owned());
        let (mut socket, _) = connect(&format!("http://127.0.0.1:{port}")).unwrap();
        assert_eq!(socket.read().unwrap(), Message::text("1"));
        assert!(server.has_been_opened());
        socket.send(Message::text("pull 2 0 0 0 10 0 0")).unwrap();
        let begin = Instant::now();
        while server.pull_w() != [10.0, 0.0, 0.0] {
            assert!(begin.elapsed() < PATIENCE);
            sleep(LOOK);
        }
        drop(socket);
        while server.pull_w() != [0.0; 3] {
            assert!(begin.elapsed() < 2 * PATIENCE, "a page that is gone pulls on");
            sleep(LOOK);
        }
    }
}
