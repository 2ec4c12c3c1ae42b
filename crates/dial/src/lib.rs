//! TCP connections within a stated time.
//!
//! In: `host:port` and a time. Out: a connection, or the reason why there is none, in at most that time.
//!
//! [`TcpStream::connect_timeout`] bounds the wait for one address; the look-up of a host's name before it, by
//! the operating system's resolver, has no time-out that a program can set, and may wait for half a minute when
//! the name server is gone. Here a thread of its own looks up and is left behind when it takes too long: it
//! ends when the resolver gives up.

use std::io;
use std::net::{SocketAddr, TcpStream, ToSocketAddrs};
use std::sync::mpsc::{self, RecvTimeoutError};
use std::time::{Duration, Instant};

/// Connects to `host:port`. All addresses of the host are tried in turn; those that do not answer share the
/// time that is left, so that one of them cannot use it up.
pub fn connect(target: &str, patience: Duration) -> io::Result<TcpStream> {
    let deadline = Instant::now() + patience;
    let addresses = match target.parse() {
        Ok(address) => vec![address],
        Err(_) => {
            let name = target.to_owned();
            look_up(patience, move || Ok(name.to_socket_addrs()?.collect()))?
        }
    };
    any(&addresses, deadline)
}

/// Connects to the first of some addresses that answers.
fn any(addresses: &[SocketAddr], deadline: Instant) -> io::Result<TcpStream> {
    let mut tried = Err(io::Error::new(io::ErrorKind::NotFound, "the host has no address"));
    for (k, address) in addresses.iter().enumerate() {
        let left = deadline.saturating_duration_since(Instant::now());
        let share = left / u32::try_from(addresses.len() - k).unwrap_or(u32::MAX);
        // Zero would be refused as no time-out.
        tried = TcpStream::connect_timeout(address, share.max(Duration::from_millis(1)));
        if tried.is_ok() {
            break;
        }
    }
    tried
}

/// What `resolve` answers, when it does in time.
fn look_up(
    patience: Duration,
    resolve: impl FnOnce() -> io::Result<Vec<SocketAddr>> + Send + 'static,
) -> io::Result<Vec<SocketAddr>> {
    let (sender, answer) = mpsc::sync_channel(1);
    let thread = std::thread::Builder::new().name("look-up".into());
    // Nobody listens any more to one that comes too late.
    thread.spawn(move || drop(sender.send(resolve())))?;
    answer.recv_timeout(patience).unwrap_or_else(|none| {
        Err(match none {
            RecvTimeoutError::Timeout => {
                let what = "looking up the host's name took too long: does the name server answer?";
                io::Error::new(io::ErrorKind::TimedOut, what)
            }
            RecvTimeoutError::Disconnected => {
                io::Error::other("the look-up of the host's name broke")
            }
        })
    })
}

#[cfg(test)]
mod tests {
    use std::net::TcpListener;

    use super::*;

    #[test]
    fn a_name_and_an_address_lead_to_the_listener() {
        let listener = TcpListener::bind("localhost:0").unwrap();
        let address = listener.local_addr().unwrap();
        for target in [address.to_string(), format!("localhost:{}", address.port())] {
            let stream = connect(&target, Duration::from_secs(5)).unwrap();
            assert_eq!(stream.peer_addr().unwrap(), address, "{target}");
        }
    }

    #[test]
    fn a_resolver_that_does_not_answer_is_given_up() {
        let (hold, held) = mpsc::channel::<()>();
        let start = Instant::now();
        let resolve = move || {
            let _ = held.recv_timeout(Duration::from_secs(30));
            Ok(Vec::new())
        };
        let error = look_up(Duration::from_millis(50), resolve).unwrap_err();
        let waited = start.elapsed();
        drop(hold);
        assert_eq!(error.kind(), io::ErrorKind::TimedOut, "{error}");
        assert!(waited < Duration::from_secs(10), "{waited:?}");
    }

    #[test]
    fn an_address_that_does_not_answer_leaves_time_for_the_next() {
        // When nobody accepts, the system at last leaves further callers without an answer.
        let [silent, good] = [(); 2].map(|()| TcpListener::bind("127.0.0.1:0").unwrap());
        let addresses = [&silent, &good].map(|listener| listener.local_addr().unwrap());
        let mut callers = Vec::new();
        while let Ok(caller) = TcpStream::connect_timeout(&addresses[0], Duration::from_millis(200))
        {
            callers.push(caller);
        }
        let start = Instant::now();
        let stream = any(&addresses, start + Duration::from_secs(2)).unwrap();
        let waited = start.elapsed();
        assert_eq!(stream.peer_addr().unwrap(), addresses[1]);
        // One of two addresses has half of the time.
        assert!(waited < Duration::from_millis(1900), "{waited:?}");
    }

    #[test]
    fn what_is_no_address_says_so() {
        for target in ["", "localhost", "localhost:", "localhost:70000", ":::"] {
            assert!(connect(target, Duration::from_secs(5)).is_err(), "{target}");
        }
    }
}
