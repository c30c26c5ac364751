//! Figures for Prometheus: a text in, an answer over HTTP to whoever on this computer asks for it out.
//!
//! Requests are answered one after the other on a thread of its own, and none may take long: whoever asks
//! neither holds up the pipeline nor, for more than a moment, the next one. There is no encryption and no
//! password, which is why only this computer may ask: by a loopback address, which any local user can
//! reach, or by a Unix socket, which only the daemon's own user and root can open.

use crate::settings::SettingError;
use serde::{Deserialize, Serialize};
use std::io::{self, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::os::unix::fs::{FileTypeExt, PermissionsExt};
use std::os::unix::net::{UnixListener, UnixStream};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// How long a request may take to come, and an answer to go.
const PATIENCE: Duration = Duration::from_secs(1);
/// Longest head of a request, bytes.
const MAX_HEAD: usize = 8192;
/// Pause after a connection that could not be taken, for example for want of file descriptors.
const PAUSE: Duration = Duration::from_millis(100);

/// The settings of `[metrics]`.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Settings {
    /// Where Prometheus may fetch figures from, `/metrics`: a loopback address with its port, or the absolute
    /// path of a Unix socket. Default none: nowhere. Other addresses are refused, since nothing is encrypted
    /// and nobody is asked for a password.
    pub listen: Option<String>,
}

impl Settings {
    /// Refuses what others than this computer could reach.
    ///
    /// # Errors
    /// The address is neither one of loopback nor an absolute path.
    pub fn check(&self) -> Result<(), SettingError> {
        self.address().map(drop)
    }

    /// Where to listen, if at all.
    ///
    /// # Errors
    /// As [`check`](Self::check).
    pub fn address(&self) -> Result<Option<Address>, SettingError> {
        let Some(listen) = &self.listen else {
            return Ok(None);
        };
        let cause = if listen.starts_with('/') {
            return Ok(Some(Address::Unix(listen.into())));
        } else {
            match listen.parse::<SocketAddr>() {
                Ok(address) if address.ip().is_loopback() => {
                    return Ok(Some(Address::Tcp(address)));
                }
                Ok(_) => "must be an address of loopback, for nothing is encrypted",
                Err(_) => {
                    "must be an address and port, such as 127.0.0.1:9477, or the absolute path of a socket"
                }
            }
        };
        Err(SettingError {
            key: "listen",
            cause: format!("{cause}, but is '{listen}'"),
        })
    }
}

/// Where is listened.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Address {
    /// A port of loopback.
    Tcp(SocketAddr),
    /// A Unix socket.
    Unix(PathBuf),
}

/// Answers requests until it is dropped, or rather, as nothing is lost by it, until the process ends.
#[derive(Debug)]
pub struct Exposition {
    address: Address,
}

impl Exposition {
    /// Begins to answer; `text` writes the figures anew for every request.
    ///
    /// # Errors
    /// The address cannot be listened on; the message names it.
    pub fn start(
        address: &Address,
        text: impl Fn() -> String + Send + 'static,
    ) -> Result<Self, String> {
        let (address, listener) = match address {
            Address::Tcp(asked) => TcpListener::bind(asked)
                .and_then(|l| Ok((Address::Tcp(l.local_addr()?), Listener::Tcp(l))))
                .map_err(|e| format!("{asked} cannot be listened on: {e}"))?,
            Address::Unix(path) => listen_at(path)
                .map(|l| (address.clone(), Listener::Unix(l)))
                .map_err(|e| format!("{} cannot be listened on: {e}", path.display()))?,
        };
        std::thread::Builder::new()
            .name("metrics".to_owned())
            .spawn(move || {
                loop {
                    // One that hangs up has asked for nothing.
                    if listener.answer_next(&text).is_err() {
                        std::thread::sleep(PAUSE);
                    }
                }
            })
            .map_err(|e| format!("a thread cannot be started: {e}"))?;
        Ok(Self { address })
    }

    /// Where is listened, with the port that the system chose where 0 was asked for.
    #[must_use]
    pub fn address(&self) -> &Address {
        &self.address
    }
}

impl std::fmt::Display for Address {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self {
            Self::Tcp(address) => write!(f, "http://{address}/metrics"),
            Self::Unix(path) => write!(f, "{}", path.display()),
        }
    }
}

impl Drop for Exposition {
    fn drop(&mut self) {
        if let Address::Unix(path) = &self.address {
            // The next start removes it where this one cannot.
            let _ = std::fs::remove_file(path);
        }
    }
}

/// Listens at a path, in the place of a socket that a killed daemon has left there.
fn listen_at(path: &Path) -> io::Result<UnixListener> {
    let is_socket = std::fs::symlink_metadata(path).is_ok_and(|m| m.file_type().is_socket());
    if is_socket {
        match UnixStream::connect(path) {
            Err(e) if e.kind() == io::ErrorKind::ConnectionRefused => std::fs::remove_file(path)?,
            _ => return Err(io::ErrorKind::AddrInUse.into()),
        }
    }
    let listener = UnixListener::bind(path)?;
    std::fs::set_permissions(path, std::fs::Permissions::from_mode(0o600))?;
    Ok(listener)
}

enum Listener {
    Tcp(TcpListener),
    Unix(UnixListener),
}

impl Listener {
    fn answer_next(&self, text: &impl Fn() -> String) -> io::Result<()> {
        match self {
            Self::Tcp(listener) => {
                let (stream, _): (TcpStream, _) = listener.accept()?;
                stream.set_read_timeout(Some(PATIENCE))?;
                stream.set_write_timeout(Some(PATIENCE))?;
                answer(stream, text)
            }
            Self::Unix(listener) => {
                let (stream, _) = listener.accept()?;
                stream.set_read_timeout(Some(PATIENCE))?;
                stream.set_write_timeout(Some(PATIENCE))?;
                answer(stream, text)
            }
        }
    }
}

/// Reads one request and answers it; what fails costs this request alone.
fn answer(mut stream: impl Read + Write, text: &impl Fn() -> String) -> io::Result<()> {
    let Ok(head) = read_head(&mut stream) else {
        return Ok(());
    };
    let (status, body) = respond(&head, text);
    let head = format!(
        "HTTP/1.1 {status}\r\nContent-Type: text/plain; version=0.0.4; charset=utf-8\r\n\
         Content-Length: {}\r\nConnection: close\r\n\r\n",
        body.len()
    );
    let _ = stream
        .write_all(head.as_bytes())
        .and_then(|()| stream.write_all(body.as_bytes()));
    Ok(())
}

/// The answer to a request's head.
fn respond(head: &str, text: &impl Fn() -> String) -> (&'static str, String) {
    let mut words = head.lines().next().unwrap_or_default().split(' ');
    let (method, target) = (words.next(), words.next().unwrap_or_default());
    let path = target.split('?').next().unwrap_or_default();
    match (method, path) {
        (Some("GET"), "/metrics") => ("200 OK", text()),
        (Some("GET"), _) => ("404 Not Found", "the figures are at /metrics\n".to_owned()),
        _ => (
            "405 Method Not Allowed",
            "only GET is understood\n".to_owned(),
        ),
    }
}

/// Reads up to the empty line that ends a request's head.
fn read_head(stream: &mut impl Read) -> io::Result<String> {
    let started = Instant::now();
    let (mut head, mut part) = (Vec::new(), [0; 1024]);
    while !head.windows(4).any(|four| four == b"\r\n\r\n") {
        let count = stream.read(&mut part)?;
        if count == 0 || head.len() > MAX_HEAD || started.elapsed() > PATIENCE {
            return Err(io::ErrorKind::InvalidData.into());
        }
        head.extend_from_slice(&part[..count]);
    }
    Ok(String::from_utf8_lossy(&head).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(listen: &str) -> Settings {
        Settings {
            listen: Some(listen.to_owned()),
        }
    }

    #[test]
    fn only_this_computer_may_ask() {
        let tcp = |text: &str| settings(text).address().expect("fits");
        assert_eq!(
            tcp("127.0.0.1:9477"),
            Some(Address::Tcp(([127, 0, 0, 1], 9477).into()))
        );
        assert!(matches!(tcp("[::1]:9477"), Some(Address::Tcp(_))));
        let unix = settings("/run/visod/metrics").address();
        assert_eq!(
            unix.expect("fits"),
            Some(Address::Unix("/run/visod/metrics".into()))
        );
        assert_eq!(Settings::default().address(), Ok(None));
        for (refused, why) in [
            ("0.0.0.0:9477", "of loopback"),
            ("192.168.1.5:9477", "of loopback"),
            ("[::]:9477", "of loopback"),
            ("9477", "an address and port"),
            ("localhost:9477", "an address and port"),
            ("run/metrics", "an address and port"),
        ] {
            let error = settings(refused).check().expect_err("refused");
            assert!(error.cause.contains(why), "{}", error.cause);
        }
    }

    /// All that comes back for a request.
    fn ask(mut stream: impl Read + Write, request: &str) -> String {
        stream.write_all(request.as_bytes()).expect("written");
        let mut answer = String::new();
        stream.read_to_string(&mut answer).expect("read");
        answer
    }

    fn on_any_port() -> (Exposition, SocketAddr) {
        let any = Address::Tcp(([127, 0, 0, 1], 0).into());
        let exposition = Exposition::start(&any, || "visod_up 1\n".to_owned()).expect("free");
        let Address::Tcp(address) = *exposition.address() else {
            panic!("was asked for a port");
        };
        (exposition, address)
    }

    #[test]
    fn the_figures_are_at_metrics_and_nowhere_else() {
        let (_exposition, address) = on_any_port();
        let get = |request: &str| ask(TcpStream::connect(address).expect("listens"), request);
        let figures = get("GET /metrics HTTP/1.1\r\nHost: here\r\n\r\n");
        assert!(figures.starts_with("HTTP/1.1 200 OK\r\n"), "{figures}");
        assert!(figures.ends_with("\r\n\r\nvisod_up 1\n"), "{figures}");
        assert!(figures.contains("Content-Length: 11\r\n"), "{figures}");
        let elsewhere = get("GET / HTTP/1.1\r\n\r\n");
        assert!(elsewhere.starts_with("HTTP/1.1 404 "), "{elsewhere}");
        let posted = get("POST /metrics HTTP/1.1\r\n\r\n");
        assert!(posted.starts_with("HTTP/1.1 405 "), "{posted}");
    }

    #[test]
    fn who_says_nothing_holds_up_the_next_for_a_moment_only() {
        let (_exposition, address) = on_any_port();
        let silent = TcpStream::connect(address).expect("listens");
        let next = TcpStream::connect(address).expect("listens");
        let figures = ask(next, "GET /metrics HTTP/1.1\r\n\r\n");
        assert!(figures.contains(" 200 OK"), "{figures}");
        drop(silent);
    }

    #[test]
    fn what_a_killed_daemon_left_is_replaced_and_a_living_one_is_not() {
        let folder = tempfile::tempdir().expect("a folder");
        let path = folder.path().join("metrics");
        drop(UnixListener::bind(&path).expect("bound"));
        let address = Address::Unix(path.clone());
        let text = || "visod_up 1\n".to_owned();
        let exposition = Exposition::start(&address, text).expect("replaced");
        let mode = std::fs::metadata(&path).expect("there").permissions();
        assert_eq!(mode.mode() & 0o777, 0o600);
        let stream = UnixStream::connect(&path).expect("listens");
        assert!(ask(stream, "GET /metrics HTTP/1.1\r\n\r\n").contains("visod_up 1"));
        let refused = Exposition::start(&address, text).expect_err("in use");
        assert!(refused.contains("cannot be listened on"), "{refused}");
        drop(exposition);
        assert!(!path.exists());
    }
}
