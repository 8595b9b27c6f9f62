use tokio::io::{AsyncReadExt, AsyncWriteExt, DuplexStream, duplex};

use super::*;

fn enter(connections: &Arc<Connections>) -> (Connection<DuplexStream>, DuplexStream) {
    let (ours, theirs) = duplex(64);
    (connections.enter(ours, None).unwrap(), theirs)
}

fn connections(strangers: usize, all: usize) -> Arc<Connections> {
    Connections::new(Room { connections: all, strangers })
}

#[tokio::test(start_paused = true)]
async fn silent_strangers_have_ten_seconds_and_callers_any_time() {
    let connections = connections(10, 20);
    tokio::spawn(Arc::clone(&connections).watch());
    let begun = Instant::now();
    let ((mut silent, _a), (mut known, mut theirs)) = (enter(&connections), enter(&connections));
    known.connect_info().admit();
    let error = silent.read_u8().await.unwrap_err();
    assert_eq!(error.kind(), io::ErrorKind::ConnectionAborted);
    let seconds = begun.elapsed().as_secs();
    assert!((10..=11).contains(&seconds), "{seconds}");
    tokio::time::sleep(Duration::from_secs(3600)).await;
    theirs.write_u8(7).await.unwrap();
    assert_eq!(known.read_u8().await.unwrap(), 7);
    drop(silent);
    assert_eq!(connections.count(), (1, 0));
}

#[tokio::test(start_paused = true)]
async fn calls_without_a_token_keep_a_connection_for_a_minute_each() {
    let connections = connections(10, 20);
    tokio::spawn(Arc::clone(&connections).watch());
    let (mut probe, mut theirs) = enter(&connections);
    for _ in 0..5 {
        tokio::time::sleep(Duration::from_secs(9)).await;
        probe.connect_info().call_without_token();
    }
    theirs.write_u8(7).await.unwrap();
    assert_eq!(probe.read_u8().await.unwrap(), 7);
    let begun = Instant::now();
    assert!(probe.read_u8().await.is_err());
    assert!((60..=61).contains(&begun.elapsed().as_secs()), "{:?}", begun.elapsed());
}

#[tokio::test]
async fn a_closed_coordinator_sends_everybody_away_until_it_opens() {
    let connections = connections(10, 20);
    let ((mut stranger, _a), (mut known, _b)) = (enter(&connections), enter(&connections));
    known.connect_info().admit();
    assert_eq!(connections.close(true), 2);
    for connection in [&mut stranger, &mut known] {
        assert_eq!(connection.read_u8().await.unwrap_err().kind(), io::ErrorKind::ConnectionAborted);
    }
    let (ours, _theirs) = duplex(64);
    assert!(connections.enter(ours, None).is_none());
    assert_eq!(connections.close(true), 0);
    drop((stranger, known));
    assert_eq!((connections.count(), connections.close(false)), ((0, 0), 0));
    let (mut again, mut theirs) = enter(&connections);
    theirs.write_u8(7).await.unwrap();
    assert_eq!(again.read_u8().await.unwrap(), 7);
}

#[tokio::test]
async fn one_stranger_too_many_ends_the_one_silent_for_longest() {
    let connections = connections(2, 20);
    let ((mut first, mut to_first), (mut second, _b)) = (enter(&connections), enter(&connections));
    first.connect_info().call_without_token();
    let (_third, _c) = enter(&connections);
    assert!(second.read_u8().await.is_err(), "it was active before the first one");
    to_first.write_u8(7).await.unwrap();
    assert_eq!(first.read_u8().await.unwrap(), 7);
    assert_eq!(connections.count(), (2, 2), "a disconnected one does not count");
    drop(second);
    assert_eq!(connections.count(), (2, 2));
}

#[tokio::test]
async fn callers_with_tokens_are_never_closed_for_strangers() {
    let connections = connections(4, 3);
    let held: Vec<_> = (0..3).map(|_| enter(&connections)).collect();
    for (connection, _) in &held {
        connection.connect_info().admit();
    }
    assert!(connections.enter(duplex(64).0, None).is_none(), "there is no room and no stranger");
    drop(held);
    assert_eq!(connections.count(), (0, 0));
    enter(&connections);
}
