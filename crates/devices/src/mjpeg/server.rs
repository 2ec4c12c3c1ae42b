//! The camera's side: pictures offered over HTTP as network cameras and single-board streamers do.
//!
//! Each path of the server is a camera. Whoever asks for it gets `multipart/x-mixed-replace` with the
//! length and the time (`X-Timestamp`, s) of every picture; a client that reads too slowly misses
//! pictures. A camera that nobody watches needs no picture: see [`MjpegServer::watched`].

use std::io::{self, BufRead, BufReader, Read, Write};
use std::net::{SocketAddr, TcpListener, TcpStream};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Duration;

const BOUNDARY: &str = "picture";
/// A client that sends or takes nothing for so long is dropped.
const PATIENCE: Duration = Duration::from_secs(2);
/// Longest request that is read (bytes).
const REQUEST: u64 = 8192;

/// A running server; stops when dropped.
pub struct MjpegServer {
    address: SocketAddr,
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

struct Shared {
    cameras: Mutex<Vec<Channel>>,
    news: Condvar,
}

struct Channel {
    path: String,
    picture: Option<Arc<Picture>>,
    clients: usize,
    closed: bool,
}

struct Picture {
    number: u64,
    jpeg: Vec<u8>,
    stamp: Duration,
}

impl MjpegServer {
    /// Serves one camera per path (`/left`) on a listener.
    pub fn start(listener: TcpListener, paths: &[&str]) -> io::Result<Self> {
        let address = listener.local_addr()?;
        let channel = |path: &&str| Channel {
            path: (*path).into(),
            picture: None,
            clients: 0,
            closed: false,
        };
        let cameras = Mutex::new(paths.iter().map(channel).collect());
        let shared = Arc::new(Shared { cameras, news: Condvar::new() });
        let serving = shared.clone();
        let thread = std::thread::Builder::new().name("mjpeg server".into()).spawn(move || {
            for stream in listener.incoming() {
                if serving.lock().iter().all(|c| c.closed) {
                    return;
                }
                let Ok(stream) = stream else { continue };
                let shared = serving.clone();
                // A client that goes away ends its thread by the error of a write.
                std::thread::spawn(move || drop(shared.attend(stream)));
            }
        })?;
        Ok(MjpegServer { address, shared, thread: Some(thread) })
    }

    /// Where it listens.
    pub fn address(&self) -> SocketAddr {
        self.address
    }

    /// Somebody watches this camera.
    pub fn watched(&self, camera: usize) -> bool {
        self.shared.lock().get(camera).is_some_and(|c| c.clients > 0)
    }

    /// The camera's next picture, taken at `stamp` on its clock.
    pub fn show(&self, camera: usize, jpeg: Vec<u8>, stamp: Duration) {
        let mut cameras = self.shared.lock();
        let Some(channel) = cameras.get_mut(camera) else { return };
        let number = channel.picture.as_ref().map_or(0, |p| p.number + 1);
        channel.picture = Some(Arc::new(Picture { number, jpeg, stamp }));
        self.shared.news.notify_all();
    }
}

impl Drop for MjpegServer {
    fn drop(&mut self) {
        self.shared.lock().iter_mut().for_each(|c| c.closed = true);
        self.shared.news.notify_all();
        // Wakes the thread that waits for the next client.
        let woken = TcpStream::connect_timeout(&self.address, PATIENCE).is_ok();
        if let Some(thread) = self.thread.take().filter(|_| woken) {
            // A panic there has been reported already.
            let _ = thread.join();
        }
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, Vec<Channel>> {
        self.cameras.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Serves one client until either side ends.
    fn attend(&self, mut stream: TcpStream) -> io::Result<()> {
        stream.set_read_timeout(Some(PATIENCE))?;
        stream.set_write_timeout(Some(PATIENCE))?;
        stream.set_nodelay(true)?;
        let path = asked_path(&stream)?;
        let found = self.lock().iter().position(|c| c.path == path);
        let Some(camera) = found else {
            let paths: Vec<String> = self.lock().iter().map(|c| c.path.clone()).collect();
            let body = format!("cameras are at {}\n", paths.join(" and "));
            let length = body.len();
            return write!(
                stream,
                "HTTP/1.0 404 Not Found\r\nContent-Length: {length}\r\n\r\n{body}"
            );
        };
        write!(
            stream,
            "HTTP/1.0 200 OK\r\nCache-Control: no-store\r\n\
             Content-Type: multipart/x-mixed-replace; boundary={BOUNDARY}\r\n\r\n"
        )?;
        self.lock()[camera].clients += 1;
        let outcome = self.stream(camera, &mut stream);
        self.lock()[camera].clients -= 1;
        outcome
    }

    fn stream(&self, camera: usize, stream: &mut TcpStream) -> io::Result<()> {
        // What was shown before this client came is not news.
        let mut last = self.lock()[camera].picture.as_ref().map(|p| p.number);
        while let Some(picture) = self.after(camera, last) {
            last = Some(picture.number);
            let head = format!(
                "--{BOUNDARY}\r\nContent-Type: image/jpeg\r\nContent-Length: {}\r\n\
                 X-Timestamp: {:.6}\r\n\r\n",
                picture.jpeg.len(),
                picture.stamp.as_secs_f64()
            );
            // One write, so that header and picture travel together.
            stream.write_all(&[head.as_bytes(), &picture.jpeg, b"\r\n"].concat())?;
        }
        Ok(())
    }

    /// The newest picture once there is another than the last; `None` when the server ends.
    fn after(&self, camera: usize, last: Option<u64>) -> Option<Arc<Picture>> {
        let mut cameras = self.lock();
        loop {
            let channel = &cameras[camera];
            if channel.closed {
                return None;
            }
            if let Some(picture) = channel.picture.as_ref().filter(|p| Some(p.number) != last) {
                return Some(picture.clone());
            }
            cameras = self.news.wait(cameras).unwrap_or_else(PoisonError::into_inner);
        }
    }
}

/// Reads a request to its end; the path that it asks for, without its query.
fn asked_path(stream: &TcpStream) -> io::Result<String> {
    let mut reader = BufReader::new(stream.take(REQUEST));
    let mut path = String::new();
    let mut line = String::new();
    loop {
        line.clear();
        if reader.read_line(&mut line)? == 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        if path.is_empty() {
            let target = line.split_whitespace().nth(1).unwrap_or_default();
            path = target.split('?').next().unwrap_or_default().to_owned();
        }
        if line.trim_end().is_empty() {
            return Ok(path);
        }
    }
}
