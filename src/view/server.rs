//! The server of the page. It listens on 127.0.0.1 alone and answers those who know the token of the printed address.
//!
//! A page of another site that the same browser shows could send requests here, too. It does not know the token, its
//! requests carry a foreign `Origin`, and a name that it makes point here (DNS rebinding) is a foreign `Host`; each
//! of the three is refused. GET is answered, and nothing is ever written; POST passes a request on to a run with
//! `--live` and needs an `Origin` of its own.
//!
//! A connection has a thread, of which there are few, and is closed when nothing comes for a while.

use std::io::{self, Read, Write};
use std::net::{Ipv4Addr, TcpListener, TcpStream};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use httparse::{EMPTY_HEADER, Request, Status};
use thiserror::Error;

use super::{Answer, Answers};

/// Connections at a time; a browser opens six for a page.
const CONNECTIONS: usize = 48;
/// Longest head of a request, bytes.
const HEAD: usize = 16 << 10;
/// Longest body of a request, bytes.
const BODY: usize = 256 << 10;
/// Most headers of a request.
const HEADER_LINES: usize = 64;
/// After this time without a request a connection is closed; the browser then opens another one.
const IDLE: Duration = Duration::from_secs(20);
/// Runs go first: the threads that answer are this much nicer.
const NICER: i32 = 10;

/// Sent with every answer. The page loads nothing from elsewhere and is shown in no other page.
const HEADERS: [(&str, &str); 7] = [
    ("Cache-Control", "no-store"),
    ("X-Content-Type-Options", "nosniff"),
    ("X-Frame-Options", "DENY"),
    ("Referrer-Policy", "no-referrer"),
    ("Cross-Origin-Resource-Policy", "same-origin"),
    ("Cross-Origin-Opener-Policy", "same-origin"),
    (
        "Content-Security-Policy",
        "default-src 'none'; script-src 'self'; worker-src 'self'; style-src 'self'; img-src 'self' data: blob:; \
         connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'",
    ),
];

/// Why the page cannot be served.
#[derive(Debug, Error)]
pub enum BindError {
    /// The port is taken, or not allowed.
    #[error("cannot listen on 127.0.0.1:{port}: {source}; another port: --port N, any free one: --port 0")]
    Port {
        /// The port asked for.
        port: u16,
        /// The error of the operating system.
        source: io::Error,
    },
    /// The system has no random numbers for the token.
    #[error("cannot make the token of the address: {0}")]
    Token(io::Error),
}

/// A server that is listening.
pub struct Server {
    listener: TcpListener,
    guard: Guard,
    answers: Answers,
    connections: AtomicUsize,
}

/// Decides who is answered.
struct Guard {
    token: String,
    port: u16,
}

impl Server {
    /// Listens on `port`, or with 0 on a free one.
    ///
    /// # Errors
    /// The port cannot be used, or there are no random numbers for the token.
    pub fn bind(port: u16, answers: Answers) -> Result<Server, BindError> {
        let token = token().map_err(BindError::Token)?;
        let taken = |source| BindError::Port { port, source };
        let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port)).map_err(taken)?;
        let port = listener.local_addr().map_err(taken)?.port();
        Ok(Server { listener, guard: Guard { token, port }, answers, connections: AtomicUsize::new(0) })
    }

    /// The address of the page.
    pub fn address(&self) -> String {
        format!("http://127.0.0.1:{}/{}/", self.guard.port, self.guard.token)
    }

    /// Starts to answer on threads of its own, as long as the process lives.
    ///
    /// # Errors
    /// The system gives no threads.
    pub fn start(self) -> io::Result<()> {
        let server = Arc::new(self);
        std::thread::Builder::new().name("page".into()).spawn(move || {
            for stream in server.listener.incoming() {
                let Ok(stream) = stream else {
                    // Too many open files, perhaps; that passes.
                    std::thread::sleep(Duration::from_millis(50));
                    continue;
                };
                let connection = Connection::new(&server);
                if server.connections.load(Ordering::Relaxed) > CONNECTIONS {
                    continue;
                }
                let thread = std::thread::Builder::new().name("page reader".into());
                if let Err(error) = thread.spawn(move || connection.serve(stream)) {
                    tracing::debug!("a connection was lost: {error}");
                }
            }
        })?;
        Ok(())
    }

    /// The answer to a request; `body`: what it brings, none if that cannot be read.
    fn answer(&self, request: &Request, body: Option<&[u8]>) -> Answer {
        let header = |name: &str| {
            let found = request.headers.iter().find(|header| header.name.eq_ignore_ascii_case(name))?;
            std::str::from_utf8(found.value).ok()
        };
        let method = request.method.unwrap_or_default();
        let asked = Asked { method, host: header("Host"), origin: header("Origin") };
        match (self.guard.check(request.path.unwrap_or_default(), &asked), body) {
            (Err(refusal), _) => refusal,
            (Ok((path, query)), _) if method == "GET" => self.answers.of(path, query),
            (Ok((path, _)), Some(body)) => self.answers.of_request(path, body),
            (Ok(_), None) => Answer::refused(400, "a request brings its length and at most 256 KiB"),
        }
    }
}

/// One of the server's connections; counted as long as it is.
struct Connection {
    server: Arc<Server>,
}

impl Connection {
    fn new(server: &Arc<Server>) -> Connection {
        server.connections.fetch_add(1, Ordering::Relaxed);
        Connection { server: server.clone() }
    }

    fn serve(&self, stream: TcpStream) {
        // On Linux this is a matter of the thread; a system that refuses it is no reason to serve nothing.
        let _ = rustix::process::nice(NICER);
        if let Err(error) = self.talk(stream) {
            // A page that was closed, most of the time.
            tracing::debug!("a connection has ended: {error}");
        }
    }

    /// Answers requests until one of both sides has enough.
    fn talk(&self, mut stream: TcpStream) -> io::Result<()> {
        stream.set_read_timeout(Some(IDLE))?;
        stream.set_write_timeout(Some(IDLE))?;
        stream.set_nodelay(true)?;
        let mut head: Vec<u8> = Vec::new();
        let mut piece = [0; 4096];
        loop {
            let mut lines = [EMPTY_HEADER; HEADER_LINES];
            let mut request = Request::new(&mut lines);
            match request.parse(&head) {
                Ok(Status::Complete(length)) => {
                    let named = |name: &str| request.headers.iter().find(|line| line.name.eq_ignore_ascii_case(name));
                    let body = match request.method {
                        Some("POST") => read_body(&mut stream, &head[length..], named("Content-Length"))?,
                        _ => None,
                    };
                    let answer = self.server.answer(&request, body.as_deref());
                    let ends = named("Connection").is_some_and(|line| line.value.eq_ignore_ascii_case(b"close"));
                    // What follows a head with a body is not looked for.
                    let has_body = named("Content-Length").is_some() || named("Transfer-Encoding").is_some();
                    let goes_on = request.version == Some(1) && !ends && !has_body;
                    send(&mut stream, &answer, goes_on)?;
                    if !goes_on {
                        return Ok(());
                    }
                    head.drain(..length);
                }
                Ok(Status::Partial) if head.len() < HEAD => {
                    let read = stream.read(&mut piece)?;
                    if read == 0 {
                        return Ok(());
                    }
                    head.extend_from_slice(&piece[..read]);
                }
                _ => return send(&mut stream, &Answer::refused(400, "this is no request of a browser"), false),
            }
        }
    }
}

/// The body of a request, of which `begun` is read already; none if it does not say a length that is allowed.
fn read_body(stream: &mut TcpStream, begun: &[u8], length: Option<&httparse::Header>) -> io::Result<Option<Vec<u8>>> {
    let length = length.and_then(|line| std::str::from_utf8(line.value).ok()?.trim().parse::<usize>().ok());
    let Some(length) = length.filter(|length| *length <= BODY) else { return Ok(None) };
    let mut body = begun[..begun.len().min(length)].to_vec();
    let there = body.len();
    body.resize(length, 0);
    stream.read_exact(&mut body[there..])?;
    Ok(Some(body))
}

impl Drop for Connection {
    fn drop(&mut self) {
        self.server.connections.fetch_sub(1, Ordering::Relaxed);
    }
}

fn send(stream: &mut TcpStream, answer: &Answer, goes_on: bool) -> io::Result<()> {
    let reason = match answer.status {
        200 => "OK",
        400 => "Bad Request",
        403 => "Forbidden",
        404 => "Not Found",
        405 => "Method Not Allowed",
        _ => "Internal Server Error",
    };
    let mut head = format!("HTTP/1.1 {} {reason}\r\n", answer.status);
    let length = answer.body.len().to_string();
    let own = [
        ("Content-Type", answer.kind),
        ("Content-Length", &length),
        ("Connection", if goes_on { "keep-alive" } else { "close" }),
    ];
    for (name, value) in own.into_iter().chain(HEADERS) {
        head += &format!("{name}: {value}\r\n");
    }
    head += "\r\n";
    stream.write_all(head.as_bytes())?;
    stream.write_all(&answer.body)
}

/// What is looked at of a request besides its address.
struct Asked<'a> {
    method: &'a str,
    host: Option<&'a str>,
    origin: Option<&'a str>,
}

impl Guard {
    /// Path after the token and query of an address that may be answered.
    fn check<'a>(&self, address: &'a str, asked: &Asked) -> Result<(&'a str, &'a str), Answer> {
        let own = |host: &str| ["127.0.0.1", "localhost"].iter().any(|name| host == format!("{name}:{}", self.port));
        if !asked.host.is_some_and(own) {
            return Err(Answer::refused(403, "this page answers to 127.0.0.1 only"));
        }
        let own_origin = |origin: &str| origin.strip_prefix("http://").is_some_and(own);
        if asked.origin.is_some_and(|origin| !own_origin(origin)) {
            return Err(Answer::refused(403, "this page does not answer other pages"));
        }
        // A browser says where a POST comes from.
        if asked.method == "POST" && asked.origin.is_none() {
            return Err(Answer::refused(403, "this page is asked by itself only"));
        }
        if !["GET", "POST"].contains(&asked.method) {
            return Err(Answer::refused(405, "this page is only read"));
        }
        let (path, query) = address.split_once('?').unwrap_or((address, ""));
        let (token, path) = path.strip_prefix('/').and_then(|path| path.split_once('/')).unwrap_or_default();
        if !same(token, &self.token) {
            return Err(Answer::refused(403, "open the address that loomtree has printed, with its token"));
        }
        Ok((path, query))
    }
}

/// Compares in a time that says nothing about where two texts differ.
fn same(a: &str, b: &str) -> bool {
    a.len() == b.len() && a.bytes().zip(b.bytes()).fold(0, |differ, (a, b)| differ | (a ^ b)) == 0
}

/// 128 random bits as text.
fn token() -> io::Result<String> {
    let mut bits = [0_u8; 16];
    std::fs::File::open("/dev/urandom")?.read_exact(&mut bits)?;
    Ok(bits.iter().map(|byte| format!("{byte:02x}")).collect())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn only_the_own_page_is_answered() {
        let guard = Guard { token: "secret".into(), port: 8000 };
        let own = Asked { method: "GET", host: Some("127.0.0.1:8000"), origin: None };
        fn status<'a>(guard: &Guard, address: &'a str, asked: &Asked) -> Result<(&'a str, &'a str), u16> {
            guard.check(address, asked).map_err(|refusal| refusal.status)
        }
        let status = |address: &'static str, asked: Asked| status(&guard, address, &asked);
        assert_eq!(status("/secret/", Asked { ..own }), Ok(("", "")));
        assert_eq!(status("/secret/run/0/state?have=1", Asked { ..own }), Ok(("run/0/state", "have=1")));
        assert_eq!(
            status("/secret/a", Asked { host: Some("localhost:8000"), origin: Some("http://localhost:8000"), ..own }),
            Ok(("a", ""))
        );
        for address in [
            "/",
            "/secret",
            "/Secret/",
            "/secre/",
            "/secrets/",
            "secret/",
            "//secret/",
            "http://127.0.0.1:8000/secret/",
        ] {
            assert_eq!(status(address, Asked { ..own }), Err(403), "{address}");
        }
        for host in [None, Some("127.0.0.1"), Some("127.0.0.1:80"), Some("evil.example:8000"), Some("0.0.0.0:8000")] {
            assert_eq!(status("/secret/", Asked { host, ..own }), Err(403), "{host:?}");
        }
        for origin in ["null", "http://evil.example", "https://127.0.0.1:8000", "http://127.0.0.1:80"] {
            assert_eq!(status("/secret/", Asked { origin: Some(origin), ..own }), Err(403), "{origin}");
        }
        assert_eq!(status("/secret/", Asked { method: "PUT", ..own }), Err(405));
        let post = Asked { method: "POST", ..own };
        assert_eq!(status("/secret/a", Asked { ..post }), Err(403));
        let origin = Some("http://127.0.0.1:8000");
        assert_eq!(status("/secret/a", Asked { origin, ..post }), Ok(("a", "")));
        assert_eq!(status("/other/a", Asked { origin, ..post }), Err(403));
    }

    #[test]
    fn tokens_are_long_and_differ() {
        let (one, other) = (token().unwrap(), token().unwrap());
        assert!(one.len() == 32 && one != other);
    }
}
