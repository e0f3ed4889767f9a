//! RTSP on the wire: its messages and the packets between them (RFC 2326, section 10.12), one at a time.

use std::io::{self, BufRead, Read};

/// A header longer than this is none.
const MOST_HEADER: usize = 64 << 10;

/// What follows next in a connection.
pub(super) enum Piece {
    /// A request or an answer, its body included.
    Message(Vec<u8>),
    /// An interleaved packet, with its four bytes in front.
    Packet(Vec<u8>),
}

/// The next piece; `None` at the end.
pub(super) fn next(from: &mut impl BufRead) -> io::Result<Option<Piece>> {
    match from.fill_buf()?.first() {
        None => Ok(None),
        Some(b'$') => {
            let mut bytes = vec![0; 4];
            from.read_exact(&mut bytes)?;
            let length = usize::from(u16::from_be_bytes([bytes[2], bytes[3]]));
            bytes.resize(4 + length, 0);
            from.read_exact(&mut bytes[4..])?;
            Ok(Some(Piece::Packet(bytes)))
        }
        Some(_) => message(from).map(|bytes| bytes.map(Piece::Message)),
    }
}

fn message(from: &mut impl BufRead) -> io::Result<Option<Vec<u8>>> {
    let mut bytes = Vec::new();
    loop {
        let begin = bytes.len();
        let room = MOST_HEADER.saturating_sub(begin);
        if from.by_ref().take(room as u64).read_until(b'\n', &mut bytes)? == 0 {
            return if begin == 0 { Ok(None) } else { Err(io::ErrorKind::InvalidData.into()) };
        }
        if matches!(&bytes[begin..], b"\r\n" | b"\n") {
            break;
        }
    }
    let length = header(&bytes, "Content-Length").and_then(|n| n.parse().ok()).unwrap_or(0usize);
    let begin = bytes.len();
    bytes.resize(begin + length.min(MOST_HEADER), 0);
    from.read_exact(&mut bytes[begin..])?;
    Ok(Some(bytes))
}

/// A field of a message's header.
pub(super) fn header<'a>(message: &'a [u8], name: &str) -> Option<&'a str> {
    let lines = message.split(|&byte| byte == b'\n').filter_map(|line| std::str::from_utf8(line).ok());
    lines
        .take_while(|line| !line.trim().is_empty())
        .filter_map(|line| line.split_once(':'))
        .find(|(field, _)| field.eq_ignore_ascii_case(name))
        .map(|(_, value)| value.trim())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn takes_a_connection_apart() {
        let request = b"TEARDOWN rtsp://x/ RTSP/1.0\r\nCSeq: 4\r\n\r\n";
        let answer = b"RTSP/1.0 200 OK\r\ncseq: 2\r\ncontent-length: 3\r\n\r\nv=0";
        let packet = b"$\x01\x00\x02ab";
        let all = [&request[..], packet, answer, packet].concat();
        let (mut from, mut seen) = (&all[..], Vec::new());
        while let Some(piece) = next(&mut from).unwrap() {
            seen.push(match piece {
                Piece::Message(bytes) => (header(&bytes, "CSeq").map(str::to_owned), bytes),
                Piece::Packet(bytes) => (None, bytes),
            });
        }
        assert_eq!(
            seen,
            [
                (Some("4".to_owned()), request.to_vec()),
                (None, packet.to_vec()),
                (Some("2".to_owned()), answer.to_vec()),
                (None, packet.to_vec()),
            ]
        );
        assert!(next(&mut &b"OPTIONS * RTSP/1.0\r\n"[..]).is_err());
        assert!(next(&mut &b"$\x00\x00\x05ab"[..]).is_err());
        assert!(next(&mut &vec![b'a'; 1 << 20][..]).is_err());
    }
}
